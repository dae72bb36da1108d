"""What does not give the same each time is no test: it is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import unsteady
from typer.testing import CliRunner

import dataflow
from dataflow.capture.capture import capture
from dataflow.capture.captured import CapturedCalls
from dataflow.capture.repeats import NotRepeated, check_repeats
from dataflow.cli.main import app
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.graph import load_text
from dataflow.recording import Recording

GRAPH = """graph: unsteady
operators:
  count: {use: "unsteady:Count"}
  op: {use: "unsteady:%s", inputs: {x: count/x}}
"""


def recorded(use: str, path: Path) -> Path:
    unsteady.CountsCalls.made.clear()
    dataflow.run(load_text(GRAPH % use), record=path)
    return path


def captured(path: Path, predicate: str = "") -> CapturedCalls:
    with Recording(path) as recording:
        return capture(recording, Debugger(recording, "op"), None, predicate).captured


def test_calls_that_give_something_else_each_time_do_not_repeat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded("CountsCalls", tmp_path / "run.mcap")
    monkeypatch.setattr("dataflow.capture.capture.check_repeats", lambda made: None)
    made = captured(path, predicate="inp.x.value == 5")

    with pytest.raises(NotRepeated, match="made again 20 times, it gives 2 different results"):
        check_repeats(replace(made, predicate="(out.out.value - inp.x.value) % 2 == 0"))
    with pytest.raises(NotRepeated, match="made again 20 times, it gives 20 different results"):
        check_repeats(replace(made, predicate="", expected={}))


def test_a_call_that_gives_something_else_in_a_new_process_is_refused(tmp_path: Path) -> None:
    path = recorded("Hashes", tmp_path / "run.mcap")
    here = hash("unsteady") % 1000

    wrong = "call 0 of op does not repeat: made again in a new process, it gives another.* dataflow verify .* --why"
    with pytest.raises(DebugError, match=wrong):
        captured(path, predicate=f"out.out.value == inp.x.value + {here}")


def test_a_call_that_repeats_is_captured(tmp_path: Path) -> None:
    path = recorded("Hashes", tmp_path / "run.mcap")

    made = captured(path, predicate="out.out.value >= inp.x.value")

    assert len(made.shots) == 1


def test_capture_is_not_advised_for_an_unrepeatable_operator(tmp_path: Path) -> None:
    path = recorded("Entropy", tmp_path / "run.mcap")
    told = CliRunner().invoke(app, ["verify", str(path)])

    assert told.exit_code == 1
    assert "it does not repeat" in " ".join(told.output.split())
    assert "dataflow capture" not in told.output
    assert "dataflow debug" in told.output
