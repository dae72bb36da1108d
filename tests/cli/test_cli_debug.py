"""`dataflow debug` on a kept recording, as it is typed."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

KEPT = Path(__file__).resolve().parent.parent / "recordings_of"
LIVE = KEPT / "live.mcap"


def debug(*words: str, lines: str = "", code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "dataflow.cli.main", "debug", str(LIVE), *words, "--path", str(KEPT)],
        input=lines,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        env={**os.environ, "COLUMNS": "120"},
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_a_call_is_shown_with_what_was_given_made_and_changed() -> None:
    told = debug("smooth@1", "--do", "state", "--do", "inputs", "--do", "print out.mean.vectors.shape")

    assert "smooth  call 29 of 42" in told
    assert "as recorded" in told
    assert "given    x" in told
    assert "identical" in told
    assert "before  " in told
    assert "  vectors" in told


@pytest.mark.long
def test_the_hashes_and_threads_are_those_of_a_run() -> None:
    told = debug("busy", "--do", "goto 0", "--do", "print __import__('os').environ['PYTHONHASHSEED']")

    assert told.endswith("0\n")


def test_lines_of_standard_input_are_done_and_one_that_cannot_be_is_an_error() -> None:
    told = debug("busy", lines="next 3\nuntil number == 9\nback\nnonsense\nuntil )\nquit\nnext\n", code=1)

    assert [line.split(",")[0] for line in told.splitlines() if "call " in line] == [
        f"busy  call {number} of 117" for number in (0, 3, 9, 8)
    ]
    assert "no command 'nonsense'; there are: again, back, diff" in told
    assert "until ): no Python expression" in told


@pytest.mark.long
def test_pdb_stops_at_the_first_line_of_process() -> None:
    told = debug("smooth", lines="step\np type(x).__name__\nc\nquit\n")

    assert "kept_operators.py(" in told
    assert "'FeatureVector'" in told
    assert told.count("as recorded") == 2


@pytest.mark.long
def test_pdb_that_is_left_leaves_the_call_as_it_was() -> None:
    told = debug("smooth", lines="step\nq\nquit\n")

    assert told.count("as recorded") == 2
    assert "BdbQuit" not in told


@pytest.mark.long
def test_calls_are_json() -> None:
    told = debug("tally", "--do", "next", "--do", "next", "--do", "diff", "--json")

    first, second, last = told.splitlines()
    assert json.loads(first)["number"] == 0
    assert json.loads(second) | {"same": True, "error": None, "operator": "tally"} == json.loads(second)
    assert last == "122 calls: all give what was recorded"


@pytest.mark.long
def test_what_cannot_begin_is_named() -> None:
    assert "there are: busy, look, smooth, tally" in debug("none", code=2)
    assert "expected the number of a call, or @SECONDS" in debug("busy@x", code=2)


@pytest.mark.long
def test_verify_prints_the_command_that_goes_to_the_difference(
    dataflow: Any, small: Path, recorded: tuple[Path, Any], tmp_path: Path
) -> None:
    changed = tmp_path / "changed.yaml"
    changed.write_text(small.read_text().replace("runtime_operators:Smooth", "verified_operators:Nudged"))

    told = dataflow("verify", recorded[0], "--graph", changed, "--one-process", "-q", code=1).stdout
    words = shlex.split(told.rpartition("next: dataflow ")[2])
    shown = dataflow(*words).stdout

    assert words[:3] == ["debug", str(recorded[0]), "smooth"]
    assert "not as recorded" in shown
    assert "  given    x" in shown
    assert "vectors[0, 2]: recorded 0.0" in shown
