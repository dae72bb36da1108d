"""Words of the command line that are taken as they stand mean what Typer would have made of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from dataflow.cli.registry import BUILT_IN, Commands
from dataflow.cli.support.values import take_plainly


def command() -> Any:
    """A command with a parameter of each kind that ours have."""
    app = typer.Typer(add_completion=False)

    @app.command()
    def example(
        streams: Annotated[list[str] | None, typer.Argument()] = None,
        path: Path | None = None,
        many: Annotated[list[Path] | None, typer.Option()] = None,
        whole: int | None = None,
        part: float = 0.5,
        word: str = "word",
        clock: Literal["auto", "header"] = "auto",
        flag: bool = False,
    ) -> None:
        pass

    return typer.main.get_command(app)


def meaning(made: Any, words: list[str]) -> Any:
    """The parameters as the function would get them, or what is wrong with the words."""
    try:
        return made.make_context("example", list(words)).params
    except Exception as error:
        return type(error).__name__, str(error)


def both(words: list[str]) -> tuple[Any, Any]:
    plain = command()
    for param in plain.params:
        take_plainly(param)
    return meaning(plain, words), meaning(command(), words)


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["a", "b/c"],
        ["--path", "."],
        ["--path", "no/such/file"],
        ["--many", "a", "--many", "b"],
        ["--whole", "x"],
        ["--whole", "1.5"],
        ["--part", "-3.25"],
        ["--part", "nan"],
        ["--part", "1e3"],
        ["--clock", "header"],
        ["--clock", "Header"],
        ["--flag", "--word", ""],
    ],
)
def test_word_is_parsed_as_by_typer(words: list[str]) -> None:
    plain, checked = both(words)

    assert repr(plain) == repr(checked)  # 1 is not 1.0, nan is nan


@given(option=st.sampled_from(["--whole", "--part", "--clock"]), word=st.text("0123456789.-+_e auto", max_size=18))
def test_numbers_and_choices_are_parsed_as_by_typer(option: str, word: str) -> None:
    plain, checked = both([f"{option}={word}"])

    assert repr(plain) == repr(checked)


def test_a_file_that_may_not_be_read_is_left_to_typer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = tmp_path / "secret"
    secret.touch()
    monkeypatch.setattr("os.access", lambda *_: False)

    plain, checked = both(["--path", str(secret)])
    assert plain == checked
    assert "not readable" in plain[1]


def test_all_commands_are_listed_without_making_one() -> None:
    commands = Commands()

    assert list(commands) == [each.called for each in BUILT_IN]
    assert len(commands) == len(BUILT_IN)
    assert commands["list"].name == "list"
    assert commands["list"] is commands["list"]


@pytest.mark.parametrize("words", [["list"], ["echo", "a/b", "-n", "3"], ["hz", "--seconds", "2.5"]])
def test_client_commands_import_neither_pydantic_nor_other_commands(words: list[str]) -> None:
    code = (
        "import sys, typer; from dataflow.cli.main import app; import dataflow.client.attach\n"
        "group = typer.main.get_command(app)\n"
        "with group.make_context('dataflow', sys.argv[1:]) as context:\n"
        "    name, command, rest = group.resolve_command(context, sys.argv[1:])\n"
        "    command.make_context(name, rest, parent=context)\n"
        "late = ('pydantic', 'dataflow.cli.commands.run', 'importlib.metadata', 'rerun')\n"
        "print(*(name for name in late if name in sys.modules))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        env={"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )

    assert done.stdout == "\n"
