"""The commands of the command line and their options, and which of them lines of a table leave untried."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from typer import Context
from typer.main import get_command
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.cli.registry import BUILT_IN


def call(*words: object, code: int = 0) -> Any:
    """Calls a command; the outcome has `exit_code`, `stdout` and `stderr`."""
    outcome = CliRunner().invoke(app, [str(word) for word in words])
    told = f"{outcome.stdout}\n{outcome.stderr}\n{outcome.exception!r}"
    assert outcome.exit_code == code, told
    assert "Traceback" not in outcome.stderr or code == 1, told
    return outcome


def commands(*, built_in: bool) -> Iterator[tuple[str, Any]]:
    """Every built-in command, or every one of other packages, with the words that call it."""
    group = get_command(app)
    named = {each.called for each in BUILT_IN}
    for called, command in _within(group):
        if (called.split()[0] in named) is built_in:
            yield called, command


def _within(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    if not hasattr(group, "list_commands"):
        yield " ".join(words), group
        return
    for name in group.list_commands(Context(group)):
        found = group.get_command(Context(group), name)
        if found is not None:
            yield from _within(found, (*words, name))


def untried(
    offered: Iterable[tuple[str, Any]], lines: Iterable[str], elsewhere: Mapping[str, tuple[str, str]]
) -> dict[str, list[str]]:
    """By command, the options in no line. `elsewhere`: command → options that another test tries (`*`: all), and why.

    Raises `AssertionError` for an option in a line that its command does not have.
    """
    found = {}
    for called, command in offered:
        words = {w for line in lines if f"{line} ".startswith(f"{called} ") for w in line.split()}
        other = elsewhere.get(called, ("", ""))[0].split()
        options = [set(p.opts) for p in command.params if not p.hidden and p.opts[0].startswith("-")]
        left = [" or ".join(opts) for opts in options if not opts & {*words, *other, "--help"}]
        if left and other != ["*"]:
            found[called] = left
        gone = {*other, *(w for w in words if w.startswith("--"))} - {"*"} - {o for p in command.params for o in p.opts}
        assert not gone, f"{called} has no {gone}"
    return found
