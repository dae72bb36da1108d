"""The commands of the first steps go on from each other: what is followed is what was started."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from doc_pages import Quoted, blocks_of, lines_of, parsed

from dataflow.graph import load_graph


@pytest.fixture(scope="module")
def quoted() -> list[Quoted]:
    """The `dataflow` commands of the README's blocks and of the first steps, from top to bottom."""
    root = Path(__file__).resolve().parents[2]
    texts = [(root / page).read_text(encoding="utf-8") for page in ("README.md", "docs/first-steps.md")]
    scripts = [block.text for text in texts for block in blocks_of(text) if block.language == "sh"]
    words = [words for script in scripts for _, words in lines_of(script)]
    return [parsed(command[1:]) for command in words if Path(command[0]).name == "dataflow"]


def test_there_are_the_commands_that_people_begin_with(quoted: list[Quoted]) -> None:
    assert {"replay", "diff", "verify", "view", "info", "run", "top", "hz", "echo", "train"} <= {
        command.words[0] for command in quoted
    }


def test_streams_that_are_followed_belong_to_the_graph_that_was_started(quoted: list[Quoted], repository: Path) -> None:
    running, followed = None, 0
    for command in quoted:
        if command.words[0] == "run":
            running = load_graph(repository / str(command.values["graph"]))
        if command.words[0] == "echo":
            assert running is not None
            followed += 1
            assert f"{running.namespace}/{command.words[1]}" in running.streams
    assert followed


def test_every_extra_has_a_row_on_the_installing_page(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    page = (repository / "docs" / "installing.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `\[(\w+)\]` \|", page, re.MULTILINE)
    assert sorted(rows) == sorted(project["optional-dependencies"])


def test_the_readme_is_short(repository: Path) -> None:
    assert len((repository / "README.md").read_text(encoding="utf-8").split()) <= 900
