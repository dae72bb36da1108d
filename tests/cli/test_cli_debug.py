"""`dataflow debug` on a kept recording, as it is typed."""

from __future__ import annotations

import json
import os
import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest

from dataflow.cli.support.debug_shell import Shell
from dataflow.debugging.debugger import Debugger
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.sync.entries import entries_of

if TYPE_CHECKING:
    from dataflow.view import ViewerSink

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


def test_call_is_shown_with_inputs_outputs_and_state_changes() -> None:
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
def test_leaving_pdb_keeps_the_call_as_recorded() -> None:
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


def test_an_editor_is_served_until_it_leaves() -> None:
    words = [sys.executable, "-m", "dataflow.cli.main", "debug", str(LIVE), "smooth@1", "--path", str(KEPT)]
    with subprocess.Popen([*words, "--dap", "0"], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        host, port = server.stdout.readline().split()[5].split(":")
        with socket.create_connection((host, int(port)), timeout=60) as editor, editor.makefile("rwb") as stream:
            told = ""
            for seq, command in enumerate(("initialize", "launch", "configurationDone", "threads", "disconnect")):
                while command == "threads" and '"stopped"' not in told:
                    told += stream.read(1).decode()
                data = json.dumps({"seq": seq, "type": "request", "command": command}).encode()
                stream.write(b"Content-Length: %d\r\n\r\n%s" % (len(data), data))
                stream.flush()
            told += stream.read().decode()
        assert server.wait(60) == 0
    assert host == "127.0.0.1"
    assert '"reason": "entry"' in told
    assert '"name": "smooth call 29 of 42' in told
    assert '"event": "terminated"' in told


class Drawing:
    """A viewer that only notes what it is given."""

    def __init__(self) -> None:
        self.drawn: list[tuple[str, int]] = []

    def log(self, stream: str, message: Message) -> bool:
        self.drawn.append((stream, message.stamp))
        return True


@pytest.fixture
def prompt(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Shell, Drawing]]:
    monkeypatch.syspath_prepend(str(KEPT))
    with Recording(LIVE) as recording:
        debugger, viewer = Debugger(recording, "smooth"), Drawing()
        yield Shell(debugger, 0, viewer=cast("ViewerSink", viewer)), viewer
        debugger.close()


def test_viewer_shows_inputs_and_outputs_of_visited_calls(prompt: tuple[Shell, Drawing]) -> None:
    shell, viewer = prompt
    shell.onecmd("goto 4")
    shell.onecmd("goto 2")
    fired = shell._debugger.at
    assert fired is not None
    given = [(entry.stream, entry.stamp) for value in fired.firing.inputs.values() for entry in entries_of(value)]
    made = [(each.stream, each.here.stamp) for each in fired.made if each.here is not None]
    assert given
    assert made
    assert viewer.drawn[-len(given + made) :] == given + made
    assert len(viewer.drawn) > len(given + made)


def test_expressions_and_parts_of_the_state_are_completed(prompt: tuple[Shell, Drawing]) -> None:
    shell, _ = prompt
    assert shell.complete_print("out", "", 0, 0) == []
    shell.onecmd("goto 4")
    assert shell.complete_print("inp.", "", 0, 0) == [f"inp.{name}" for name in shell._debugger.node.inputs]
    assert "out.mean.vectors" in shell.complete_until("out.mean.v", "", 0, 0)
    before = shell._debugger.at.states()[0] if shell._debugger.at else None
    assert shell.complete_state("", "", 0, 0) == sorted(before or ())


def test_keys_of_the_state_are_completed(prompt: tuple[Shell, Drawing]) -> None:
    shell, _ = prompt
    shell.onecmd("goto 4")
    assert shell._debugger.at is not None
    state = shell._debugger.at.states()[0] or {}
    name = next(iter(state))

    def completed(line: str, text: str) -> list[str]:
        return shell.complete_print(text, line + text, len(line), len(line + text))

    assert name in completed('print before["', name[:1])
    assert name in completed("print 1 + after['", "")
    assert completed('print before["none"]["', "") == []
    assert "lambda" in [word.strip() for word in completed("print ", "la")]


def test_an_interrupt_clears_the_line_and_stays(
    prompt: tuple[Shell, Drawing], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shell, _ = prompt
    lines = iter([KeyboardInterrupt(), "print 6 * 7", KeyboardInterrupt(), "quit"])

    def typed(prompt: str) -> str:
        line = next(lines)
        if isinstance(line, KeyboardInterrupt):
            raise line
        return line

    monkeypatch.setattr("builtins.input", typed)
    shell.onecmd("goto 0")
    shell.converse("begins")

    assert capsys.readouterr().out.endswith("42\n\n")
    assert next(lines, None) is None


@pytest.mark.long
def test_debugging_an_unknown_operator_or_call_is_refused() -> None:
    assert "there are: busy, look, smooth, tally" in debug("none", code=2)
    assert "expected the number of a call, or @SECONDS" in debug("busy@x", code=2)


@pytest.mark.long
def test_verify_prints_the_command_that_goes_to_the_difference(
    dataflow: Any, small: Path, recorded: tuple[Path, Any], tmp_path: Path
) -> None:
    changed = tmp_path / "changed.yaml"
    changed.write_text(small.read_text().replace("runtime_operators:Smooth", "verified_operators:Nudged"))

    told = dataflow("verify", recorded[0], "--graph", changed, "--jobs", "1", "-q", code=1).stdout
    words = shlex.split(told.rpartition("next: dataflow ")[2])
    shown = dataflow(*words).stdout

    assert words[:3] == ["debug", str(recorded[0]), "smooth"]
    assert "not as recorded" in shown
    assert "  given    x" in shown
    assert "vectors[0, 2]: recorded 0.0" in shown
