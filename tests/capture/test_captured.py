"""A captured call is the same when it is read back, and refused where nothing is wrong with it."""

from __future__ import annotations

import ast
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import seeded_bugs
import vision_language
from typer.testing import CliRunner
from zoo import bugs, tuned

import dataflow
from dataflow.capture.capture import capture, write_test
from dataflow.capture.captured import CapturedCalls, Change
from dataflow.cli.main import app
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.recording import Recording
from dataflow.state import StateError

CASES = {case.use.__name__: case for case in bugs.CASES}


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return seeded_bugs.recorded(CASES["LateBatch"], tmp_path_factory.mktemp("late") / "run.mcap")


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tuned.recorded(tmp_path_factory.mktemp("changed") / "run.mcap")


@pytest.fixture(autouse=True)
def _made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """New processes are for `test_repeats`."""
    monkeypatch.setattr("dataflow.capture.capture.check_repeats", lambda made: None)


def captured(path: Path, operator: str = "bug", number: int | None = None, predicate: str = "") -> CapturedCalls:
    with Recording(path) as recording:
        return capture(recording, Debugger(recording, operator), number, predicate).captured


def test_captured_call_survives_its_file(late: Path) -> None:
    made = captured(late)
    read = CapturedCalls.from_bytes(made.to_bytes())

    assert (read.setting, read.state, read.predicate) == (made.setting, made.state, made.predicate)
    assert [shot.firing for shot in read.shots] == [shot.firing for shot in made.shots]
    with pytest.raises(AssertionError, match=r"bug: out\.vectors: .* \(expected against made\)"):
        read.check()
    with pytest.raises(ValueError, match="no captured call"):
        CapturedCalls.from_bytes(b"something else")


def test_capturing_a_call_without_error_is_refused(late: Path) -> None:
    with pytest.raises(DebugError, match="call 3 of bug: as recorded, no error"):
        captured(late, number=3)
    with pytest.raises(DebugError, match="bug has 401 calls: none for which stamp < 0"):
        captured(late, predicate="stamp < 0")


def test_a_predicate_about_any_call_is_captured(late: Path) -> None:
    made = captured(late, predicate=f"stamp > {bugs.STAMP + 5 * 10**9}")

    assert len(made.shots) == 1
    assert made.shots[0].firing.inputs["rare"] == ()  # not needed for that


def test_capture_starts_from_a_state_only_with_too_many_calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = seeded_bugs.recorded(bugs.Case(bugs.Drifts), tmp_path / "run.mcap")

    made = captured(path)

    assert made.state is None
    assert len(made.shots) == 52
    with pytest.raises(ValueError, match="out of range"):
        made.check()
    with monkeypatch.context() as patch:
        patch.setenv("ZOO_FIXED", "1")
        made.check()
    monkeypatch.setattr("dataflow.capture.capture.LARGE", 100)
    assert captured(path).state is not None
    monkeypatch.undo()
    monkeypatch.setattr("dataflow.capture.capture.check_repeats", lambda made: None)
    monkeypatch.setattr("dataflow.capture.capture.SLOW", 0.0)
    assert captured(path).state is not None


def test_answers_of_a_service_are_in_the_test(tmp_path: Path) -> None:
    with vision_language.service() as url:
        dataflow.run(vision_language.graph(url), record=tmp_path / "run.mcap")

    made = captured(tmp_path / "run.mcap", "describe", predicate="'nothing' not in out.text.text")

    outcome = CapturedCalls.from_bytes(made.to_bytes()).play()
    assert outcome.error is None
    assert re.search(r" at 0\.\d+", outcome.outputs["text"].text)


def test_text_of_the_recording_is_no_code_of_the_test(late: Path, tmp_path: Path) -> None:
    path = tmp_path / "test_late.py"
    with Recording(late) as recording:
        found = capture(recording, Debugger(recording, "bug"))
    hostile = """x\"\"\"\nraise SystemExit \\N \udcff\r\u2028raise SystemExit"""

    write_test(replace(found, wrong=hostile), path, hostile, hostile)

    text = path.read_text()
    kinds = [type(part).__name__ for part in ast.parse(text).body]
    assert kinds == ["Expr", "ImportFrom", "ImportFrom", "FunctionDef"]
    assert ast.get_docstring(ast.parse(text)) == "A captured call: fails until the operator is mended."
    assert "\\udcff" in text


def test_a_parameter_is_changed_where_it_was(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = captured(changed, "tuned")

    changes = [(shot.firing.inputs["x"].value.vectors[0, 0], shot.changes) for shot in made.shots if shot.changes]
    assert [(k, change.name, change.value) for k, [change] in changes] == [(tuned.CHANGED, "factor", 3.0)]
    read = CapturedCalls.from_bytes(made.to_bytes())
    with pytest.raises(AssertionError, match=r"tuned: out\.vectors"):
        read.check()
    monkeypatch.setenv("ZOO_FIXED", "1")
    read.check()


@pytest.mark.long
def test_changes_of_calls_that_are_left_out_are_made(changed: Path) -> None:
    made = captured(changed, "tuned", predicate=f"out.out.vectors[0, 0] == -1 and inp.x.vectors[0, 0] == {tuned.WRONG}")

    assert [[change.value for change in shot.changes] for shot in made.shots] == [[3.0]]


def test_a_reset_is_made_where_it_was(changed: Path) -> None:
    made = captured(changed, "tuned")
    *earlier, last = made.shots
    reset = Change("reset", "x", None, (0, last.firing.stamp - 1))

    again = replace(made, shots=(*earlier, last._replace(changes=(reset,))))

    read = CapturedCalls.from_bytes(again.to_bytes())
    assert read.shots[-1].changes == (reset,)
    outcome = replace(read, shots=(*read.shots[:-1], read.shots[-1]._replace(firing=earlier[-1].firing))).play()
    assert outcome.outputs["out"].vectors[0, 0] == 3.0 * (tuned.WRONG - 1)


@pytest.mark.long
def test_calls_that_give_something_else_apart_are_no_test(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.capture.capture.changes_between", lambda *_: {})

    with Recording(changed) as recording:
        found = capture(recording, Debugger(recording, "tuned"))

    assert found.begins.startswith("the state that it has here")


def test_a_silent_output_is_none_for_an_expression(changed: Path) -> None:
    made = captured(changed, "rare", predicate="out.out is None")

    assert [shot.firing.inputs["x"].value.vectors[0, 0] for shot in made.shots] == [5.0]
    with pytest.raises(AssertionError, match=r"rare: out\.out is None"):
        made.check()
    with pytest.raises(AssertionError, match=r"out\.out\.vectors.* raises AttributeError: .*whether the call is right"):
        replace(made, predicate="out.out.vectors[0, 0] > 3").check()


def test_a_captured_state_is_taken_over_by_a_class_with_more_fields(
    changed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = captured(changed, "tuned").state
    assert state is not None
    former = replace(captured(changed, "tuned"), state=pack_state({}))
    made = replace(former, state=pack_state(unpack_state(state) | {"gone": 1}))

    monkeypatch.setenv("ZOO_FIXED", "1")
    made.check()
    with pytest.raises(AssertionError, match="tuned: out"):
        former.check()  # begins with a total of 0, the default
    with pytest.raises(
        StateError, match=r"tuned: the captured state does not fit the class as it is now: .*capture the"
    ):
        replace(former, state=pack_state({"total": "much"})).check()


def test_a_call_that_raises_now_is_not_mended(late: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = captured(late, predicate=f"stamp > {bugs.STAMP + 5 * 10**9}")

    def broken(operator: bugs.LateBatch, x: object, rare: object) -> None:
        raise RuntimeError("a broken fix")

    monkeypatch.setattr(bugs.LateBatch, "process", broken)
    with pytest.raises(RuntimeError, match="a broken fix"):
        replace(made, predicate="out.out is not None and out.out.vectors[0, 0] > 3").check()
    replace(made, predicate="stamp < 0", recorded_error="RuntimeError: a broken fix").check()  # as recorded


@pytest.mark.long
def test_an_expression_that_raises_for_every_call_is_reported(changed: Path) -> None:
    with pytest.raises(DebugError, match=r"none for which out\.outt\.value > 3, which raises AttributeError: .*outt"):
        captured(changed, "rare", predicate="out.outt.value > 3")
    with pytest.raises(DebugError, match=r"call 3 of rare: it is not so: not out\.out$"):
        captured(changed, "rare", 3, "not out.out")
    # raises for one call alone
    with pytest.raises(DebugError, match=r"none for which out\.out\.vectors\[0, 0\] > 999$"):
        captured(changed, "rare", predicate="out.out.vectors[0, 0] > 999")


def test_inputs_in_memory_are_bounded_by_bytes(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.capture.capture.MOST_BYTES", 16)

    with Recording(changed) as recording:
        found = capture(recording, Debugger(recording, "tuned"))
    assert found.begins.startswith("the state that it has here")
    monkeypatch.setattr("dataflow.capture.capture.MOST_BYTES", 0)
    with pytest.raises(DebugError, match="the inputs up to it are more than 0 bytes"):
        captured(changed, "tuned")


@pytest.mark.long
def test_an_interrupt_ends_the_calls(changed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(operator: tuned.Tuned, x: object) -> None:
        raise KeyboardInterrupt

    made = captured(changed, "tuned")
    monkeypatch.setattr(tuned.Tuned, "process", interrupted)

    with pytest.raises(KeyboardInterrupt):
        made.play()


def test_the_command_writes_a_test_and_its_data(late: Path, tmp_path: Path) -> None:
    words = ["capture", str(late), "--op", "bug", "--to", str(tmp_path / "test_late.py"), "--path", str(tmp_path)]

    told = CliRunner().invoke(app, [*words, "--json"])

    assert told.exit_code == 0, told.output
    answer = json.loads(told.stdout)
    assert (answer["calls"], answer["kept"], answer["wrong"]) == (401, 1, "differs in out")
    assert answer["bytes"] == (tmp_path / "test_late.capture").stat().st_size < 1_000_000
    text = (tmp_path / "test_late.py").read_text()
    assert re.search(rf"dataflow capture run.mcap --op bug --firing \d+ --path {re.escape(str(tmp_path))}`", text)
    assert "def test_bug_" in text
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "test_late.py exists" in " ".join(again.output.split())
    wrong = CliRunner().invoke(app, [*words, "--overwrite", "--predicate", "out ="])
    assert wrong.exit_code == 2
    assert "no Python expression" in wrong.output
