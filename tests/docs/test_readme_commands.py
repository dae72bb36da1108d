"""Every command line of the README names a command, options and files that there are (or that it would make)."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer

from dataflow.cli.main import app
from dataflow.graph import GraphError, load_graph

REPOSITORY = Path(__file__).resolve().parents[2]
OUTPUTS = ("record", "view", "to", "complete", "out", "junit", "svg")
"""Parameters that name a file which the command writes."""


@dataclass(frozen=True)
class Quoted:
    """A command of a code block: its words, and the values that its own parser makes of them, by parameter."""

    words: tuple[str, ...]
    values: dict[str, Any]

    def files(self, *, written: bool) -> Iterator[str]:
        for name, value in self.values.items():
            for item in value if isinstance(value, (list, tuple)) else [value]:
                text = str(item) if isinstance(item, (str, Path)) else ""
                if re.search(r"\.(mcap|rrd|yaml|onnx|xml|svg)$", text) and (name in OUTPUTS) == written:
                    yield text.rpartition("=")[2]


def commands() -> list[list[str]]:
    """The arguments of each `dataflow` command in the README's code blocks, from top to bottom."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    found = []
    fenced = False
    for line in text.splitlines():
        fenced ^= line.startswith("```")
        if fenced or line.startswith("    "):
            for part in line.split("&&"):
                if match := re.match(r"\s*(?:\S*/)?dataflow\s+(\S.*)", part):
                    found.append(shlex.split(match[1], comments=True))
    return found


def parsed(words: list[str]) -> Quoted:
    """Raises typer's own error for an option, a value or an argument that cannot be."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    command: Any = typer.main.get_command(app)
    name, *rest = words
    if name in project["entry-points"]["dataflow.commands"]:
        module, _, attribute = project["entry-points"]["dataflow.commands"][name].partition(":")
        command = typer.main.get_command(getattr(__import__(module, fromlist=[attribute]), attribute))
    else:
        command = command.commands[name]
    while getattr(command, "commands", None):
        name, *rest = rest
        command = command.commands[name]
    context = command.make_context(name, rest)
    return Quoted(tuple(words), {key: value for key, value in context.params.items() if value not in (None, (), [])})


@pytest.fixture(scope="module")
def quoted() -> list[Quoted]:
    return [parsed(words) for words in commands()]


def test_there_are_the_commands_that_people_begin_with(quoted: list[Quoted]) -> None:
    assert {"replay", "diff", "verify", "view", "info", "run", "top", "hz", "echo", "train"} <= {
        command.words[0] for command in quoted
    }


def test_the_table_of_commands_has_every_command() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `dataflow (\S+?)[` ]", text, re.MULTILINE)
    command: Any = typer.main.get_command(app)
    assert sorted(listed) == sorted({*command.commands, *project["entry-points"]["dataflow.commands"]})


def test_every_file_is_in_the_project_or_was_made_by_an_earlier_command(quoted: list[Quoted]) -> None:
    made = {"FastestDet.onnx"}  # the reader's own, with a link to where it is
    for command in quoted:
        for file in command.files(written=False):
            assert file in made or (REPOSITORY / file).is_file(), f"{shlex.join(command.words)}: where is {file}?"
        made.update(command.files(written=True))


def test_every_setting_is_a_parameter_of_its_graph(quoted: list[Quoted]) -> None:
    with_settings = [command for command in quoted if command.values.get("settings")]
    assert with_settings
    for command in with_settings:
        load_graph(REPOSITORY / str(command.values["graph"]), settings=command.values["settings"])
    with pytest.raises(GraphError):
        load_graph(REPOSITORY / "graphs" / "simulated_robot.yaml", settings=["wrld=corridor"])


def test_streams_that_are_followed_belong_to_the_graph_that_was_started(quoted: list[Quoted]) -> None:
    running, followed = None, 0
    for command in quoted:
        if command.words[0] == "run":
            running = load_graph(REPOSITORY / str(command.values["graph"]))
        if command.words[0] == "echo":
            assert running is not None
            followed += 1
            assert f"{running.namespace}/{command.words[1]}" in running.streams
    assert followed


@pytest.mark.parametrize(
    "line", ["replay a.mcap --rate fast", "replay", "run graphs/simulated_robot.yaml --sideways", "train pilot DATA"]
)
def test_a_command_that_cannot_be_typed_is_found(line: str) -> None:
    with pytest.raises(Exception, match=r"(?i)number|missing|sideways|pilot"):
        parsed(line.split())
