"""Help, version and wrong words: what a user meets first."""

from __future__ import annotations

import re
from collections.abc import Iterator
from inspect import getdoc
from pathlib import Path

import pytest
from typer import Context
from typer.main import get_command

from dataflow.cli.app import call
from dataflow.cli.main import app
from dataflow.cli.registry import BUILT_IN, Command, Commands, Family
from dataflow.cli.support import arguments
from dataflow.sync.stamps import parse_duration

COMMANDS = sorted(each.called for each in BUILT_IN if isinstance(each, Command))


def test_the_help_documents_the_exit_codes_and_lists_every_command(dataflow) -> None:
    told = dataflow("--help").stdout

    for code in ("0 ", "1 ", "2 ", "130 "):
        assert f"\n   {code}" in told
    assert all(f"│ {command} " in told for command in COMMANDS)
    assert not [word for word in ("bool", "--install-completion", "--show-completion") if word in told]


def test_the_version_is_that_of_the_package(dataflow) -> None:
    from importlib.metadata import version

    assert dataflow("--version").stdout == f"dataflow {version('robot-dataflow')}\n"


def test_a_wrong_command_or_option_is_answered_with_the_nearest_and_code_2(dataflow) -> None:
    assert "Did you mean 'replay'" in dataflow("reply", code=2).stderr
    assert "--bogus" in dataflow("list", "--bogus", code=2).stderr


def test_our_own_tracebacks_are_shown_only_when_asked_for(dataflow, small: Path, monkeypatch) -> None:
    monkeypatch.setenv("DATAFLOW_TRACEBACK", "0")  # restored afterwards: the option sets it
    assert "Traceback" not in dataflow("info", small, code=2).stderr

    from typer.testing import CliRunner

    for words in (["--traceback", "info", str(small)], ["info", str(small), "--traceback"]):
        monkeypatch.setenv("DATAFLOW_TRACEBACK", "0")
        told = CliRunner().invoke(app, words)
        assert told.exit_code == 2
        assert "Traceback (most recent call last)" in told.stderr
        assert "not an MCAP file" in told.stderr


@pytest.mark.parametrize("asked", ["0", "1"])
def test_a_fault_of_ours_is_one_message_and_code_2(monkeypatch, capsys, asked: str) -> None:
    def faulty() -> None:
        raise KeyError("nobody thought of this")

    monkeypatch.setattr("dataflow.cli.app.app", faulty)
    monkeypatch.setenv("DATAFLOW_TRACEBACK", asked)

    with pytest.raises(SystemExit) as ended:
        call()

    told = capsys.readouterr().err
    assert ended.value.code == 2
    assert "internal error: KeyError: 'nobody thought of this'" in told
    assert ("Traceback" in told) == (asked == "1")


def every_command() -> Iterator[tuple[str, ...]]:
    """Yields the words that call each command, group and subcommand, of plug-ins too."""
    group = get_command(app)
    context = Context(group)
    for name in group.list_commands(context):
        inner = group.get_command(context, name)
        yield from ((name,), *((name, each) for each in getattr(inner, "commands", {})))


def test_every_help_has_examples_of_its_command_and_explains_options_without_types(dataflow, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in every_command():
        told = dataflow(*words, "--help").stdout
        lines = told.splitlines()
        examples = [line.strip() for line in lines if line.startswith("   dataflow ")]  # one space is the page's margin
        assert any(line.strip() == "Examples:" for line in lines), words
        assert examples, words
        assert all(line.split()[1 : 1 + len(words)] == list(words) for line in examples), words
        if words in [(command,) for command in COMMANDS]:  # each stays on a line
            documented = (getdoc(Commands()[words[0]].callback) or "").splitlines()
            assert examples == [line.strip() for line in documented if "dataflow " in line and line.startswith("  ")]

        options = told[told.index("─ Options") :]
        assert "--help" in options, words
        assert not [kind for kind in ("<int", "<float", "<str", "<path", "<bool") if kind in options], words
        assert not [
            word for word in ("[default: None]", "bool", "--install-completion", "--show-completion") if word in told
        ], words


def test_times_in_the_help_are_times_to_the_commands() -> None:
    told = [*(text for each in BUILT_IN for text in _texts(each)), *vars(arguments).values()]
    words = re.findall(r"\b\d+(?:ms|s|m|min|h|us|ns)\b", " ".join(map(str, told)))

    assert len(words) > 8
    for word in words:
        assert parse_duration(word) > 0


def _texts(command: Command | Family) -> list[str]:
    made = command.make()
    return [made.help, *(str(param.help) for param in made.params if getattr(param, "help", None))]


def test_a_recording_is_begun_and_ended_at_a_duration_with_a_unit(dataflow, recorded, tmp_path: Path) -> None:
    for words in (("--start", "0.1", "--end", "0.2"), ("--start", "100ms", "--end", "200ms")):
        dataflow("convert", recorded[0], tmp_path / words[1], "--to", "csv", "--stream", "left/fast", *words)
    assert len({file.read_text() for file in tmp_path.rglob("*.csv")}) == 1

    assert "unknown unit" in dataflow("replay", recorded[0], "--start", "2m", code=2).stderr
    assert "expected a number and a unit" in dataflow("verify", recorded[0], "--start", "soon", code=2).stderr
