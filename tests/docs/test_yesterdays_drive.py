"""The tutorial of a failure in the field: its commands lead from the recording to the line, the test and the proof."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from doc_pages import blocks_of, lines_of

COMMANDS = {"dataflow": ("-m", "dataflow.cli.start"), "pytest": ("-m", "pytest", "-p", "no:cacheprovider")}
FAILS = ("# fails", "# finds a difference")


@pytest.mark.long
def test_every_block_of_the_page_runs_and_prints_as_shown(repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "yesterdays-drive.md").read_text(encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}
    printed, ran = "", 0
    for block in blocks_of(page):
        if block.file:
            (tmp_path / block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "text":
            missing = [line for line in block.text.splitlines() if line.strip() not in printed]
            assert not missing, printed
        else:
            assert block.language == "sh"
            printed = ""
            for number, words in lines_of(block.text):
                given = [sys.executable, *COMMANDS[words[0]]] if words[0] in COMMANDS else [words[0]]
                done = subprocess.run(
                    [*given, *words[1:]], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=100
                )
                line = block.text.splitlines()[number - 1]
                assert (done.returncode != 0) == line.endswith(FAILS), (line, done.stdout, done.stderr)
                printed += done.stdout
                ran += 1
    assert ran == 10
