"""Ctrl-C, closed and full outputs, folders that are gone: one line and an exit code, at any moment."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from foreign_mcap import foreign_mcap
from rich.text import Text

from dataflow.cli.app import call
from dataflow.cli.support import output
from dataflow.cli.support.output import print_json

PACKAGE = Path(__file__).resolve().parents[2]
START = [sys.executable, "-P", "-m", "dataflow.cli.start"]

INTERRUPTED_IMPORT = """\
import os, signal, sys

wanted = sys.argv.pop(1)

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == wanted:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupts())
from dataflow.cli.start import main
main()
"""


def shell(command: str, *words: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """`command` as the shell reads it; "$@" there is `dataflow` with `words`."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PACKAGE), os.environ.get("PYTHONPATH", "")])}
    call = ["sh", "-c", command, "sh", *START, *map(str, words)]
    return subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("module", ["typer", "dataflow.cli.commands.recordings", "dataflow.recording"])
def test_ctrl_c_while_something_is_imported_is_no_error(small: Path, module: str) -> None:
    told = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_IMPORT, module, "info", str(small)],
        env={**os.environ, "PYTHONPATH": str(PACKAGE)},
        capture_output=True,
        text=True,
        timeout=60,
    )

    assert told.returncode == 130
    assert "Traceback" not in told.stderr
    assert told.stdout == ""


def test_wrapped_keyboard_interrupt_is_an_interrupt(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def interrupted() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as pressed:
            raise RuntimeError("Error calling __set_name__") from pressed  # as Python 3.11 does

    monkeypatch.setattr("dataflow.cli.app.app", interrupted)
    with pytest.raises(KeyboardInterrupt):
        call()
    with pytest.raises(KeyboardInterrupt), output.friendly_errors():
        interrupted()
    assert capsys.readouterr().err == ""


def test_a_closed_output_is_refused(small: Path, tmp_path: Path) -> None:
    recording = tmp_path / "made.mcap"
    told = shell('exec "$@" >&-', "run", small, "--record", recording)

    assert told.returncode == 2
    assert told.stderr == "error: standard output is closed; > /dev/null discards it\n"
    assert not recording.exists()


@pytest.mark.long
def test_a_closed_error_output_does_not_keep_a_command_from_its_work(small: Path) -> None:
    told = shell('exec "$@" 2>&- <&-', "check", small)

    assert told.returncode == 0
    assert told.stdout.startswith("ok ")
    assert shell('exec "$@" 2>&-', "check", "nothing.yaml").returncode == 2


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("--version",), marks=pytest.mark.long),
        ("check", "{small}"),
        pytest.param(("check", "{small}", "--json"), marks=pytest.mark.long),
    ],
)
def test_a_full_disk_behind_the_output_is_one_line(small: Path, words: tuple[str, ...]) -> None:
    told = shell('exec "$@" >/dev/full', *(word.format(small=small) for word in words))

    assert told.returncode == 2
    assert told.stderr == "error: standard output cannot be written: No space left on device\n"


def test_a_reader_that_has_seen_enough_is_no_error(recorded) -> None:
    told = shell('"$@" | true', "info", recorded[0])

    assert told.stderr == ""


@pytest.mark.long
def test_command_works_in_a_deleted_working_directory(recorded, tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    told = shell('rmdir "$PWD"; exec "$@"', "info", recorded[0], folder=gone)
    assert (told.returncode, told.stderr) == (0, "")

    gone.mkdir()
    told = shell('rmdir "$PWD"; exec "$@"', "info", "run.mcap", folder=gone)
    assert told.returncode == 2
    assert told.stderr.startswith("error: ")
    assert "Traceback" not in told.stderr
    assert "internal error" not in told.stderr


ESCAPES = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202e\udc80"


def test_control_characters_never_reach_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    written = io.StringIO()
    console = output._console(stderr=False)
    monkeypatch.setattr(console, "file", written)
    console.print(Text(f"a{ESCAPES}b"), soft_wrap=True)
    table = output.table("stream")
    table.add_row(Text(f"a{ESCAPES}b"))
    console.print(table)
    print_json({"name": ESCAPES})
    told = written.getvalue() + capsys.readouterr().out

    assert not any(ord(c) < 32 and c != "\n" for c in told)
    assert not set(told) & {"\x9b", "\u202e", "\udc80"}
    assert told.count("\\x1b[2J") >= 2


def test_names_in_a_recording_are_shown_without_their_escapes(dataflow, tmp_path: Path) -> None:
    path = foreign_mcap(
        tmp_path / "escape.mcap",
        [("/a\x1b[2J/[red]x", 1, b"{}")],
        profile="[bold]p\x1b[2J",
        library="\x1b]0;owned\x07",
        schema="s\x1b[31m",
        metadata={"recording": {"namespace": "\x9b2J"}},
    )
    for words in (["info", path], ["info", path, "--metadata"], ["info", path, "--json"], ["diff", path, path]):
        told = dataflow(*words)
        for text in (told.stdout, told.stderr):
            assert "\x1b" not in text
            assert "\x9b" not in text
    assert "/[red]x" in json.loads(dataflow("info", path, "--json").stdout)["streams"][0]["name"]
    assert "\\x1b" in dataflow("info", path).stdout


def test_a_name_of_a_million_characters_is_cut_and_the_rest_counted(dataflow, tmp_path: Path) -> None:
    path = foreign_mcap(tmp_path / "long.mcap", [("/" + "x" * 1_000_000, 1, b"{}")])
    for words in (["info", path], ["diff", path, path]):
        told = dataflow(*words)
        assert told.exit_code == 0
        assert "more characters)" in " ".join(told.stdout.split())
        assert len(told.stdout) < 100_000


def test_diff_leaves_logs_out(dataflow, tmp_path: Path) -> None:
    for name, text in (("a.mcap", b'{"text": "1 ms"}'), ("b.mcap", b'{"text": "2 ms"}')):
        foreign_mcap(tmp_path / name, [("/result", 1, b"{}"), ("/@/logs", 1, text)], schema="s")

    assert dataflow("diff", tmp_path / "a.mcap", tmp_path / "b.mcap").exit_code == 0
