"""A captured call is the same when it is read back, and refused where nothing is wrong with it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import seeded_bugs
import vision_language
from typer.testing import CliRunner
from zoo import bugs

import dataflow
from dataflow.capture.capture import capture
from dataflow.capture.captured import Captured
from dataflow.cli.main import app
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.recording import Recording

CASES = {case.use.__name__: case for case in bugs.CASES}


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return seeded_bugs.recorded(CASES["LateBatch"], tmp_path_factory.mktemp("late") / "run.mcap")


def captured(path: Path, operator: str = "bug", number: int | None = None, predicate: str = "") -> Captured:
    with Recording(path) as recording:
        return capture(recording, Debugger(recording, operator), number, predicate).captured


def test_a_captured_call_comes_back_from_its_file(late: Path) -> None:
    made = captured(late)
    read = Captured.from_bytes(made.to_bytes())

    assert (read.setting, read.state, read.predicate) == (made.setting, made.state, made.predicate)
    assert [shot.firing for shot in read.shots] == [shot.firing for shot in made.shots]
    with pytest.raises(AssertionError, match=r"bug: out\.vectors: .* \(expected against made\)"):
        read.check()
    with pytest.raises(ValueError, match="no captured call"):
        Captured.from_bytes(b"something else")


def test_what_is_as_recorded_is_refused(late: Path) -> None:
    with pytest.raises(DebugError, match="call 3 of bug: as recorded, no error"):
        captured(late, number=3)
    with pytest.raises(DebugError, match="bug has 401 calls: none for which stamp < 0"):
        captured(late, predicate="stamp < 0")


def test_a_predicate_about_any_call_is_captured(late: Path) -> None:
    made = captured(late, predicate=f"stamp > {bugs.STAMP + 5 * 10**9}")

    assert len(made.shots) == 1
    assert made.shots[0].firing.inputs["rare"] == ()  # not needed for that


def test_answers_of_a_service_are_in_the_test(tmp_path: Path) -> None:
    with vision_language.service() as url:
        dataflow.run(vision_language.graph(url), record=tmp_path / "run.mcap")

    made = captured(tmp_path / "run.mcap", "describe", predicate="'nothing' not in out.text.text")

    outcome = Captured.from_bytes(made.to_bytes()).play()
    assert outcome.error is None
    assert re.search(r" at 0\.\d+", outcome.outputs["text"].text)  # type: ignore[attr-defined]


def test_the_command_writes_a_test_and_its_data(late: Path, tmp_path: Path) -> None:
    words = ["capture", str(late), "--op", "bug", "--to", str(tmp_path / "test_late.py")]

    told = CliRunner().invoke(app, [*words, "--json"])

    assert told.exit_code == 0, told.output
    answer = json.loads(told.stdout)
    assert (answer["calls"], answer["kept"], answer["wrong"]) == (401, 1, "differs in out")
    assert answer["bytes"] == (tmp_path / "test_late.capture").stat().st_size < 1_000_000
    text = (tmp_path / "test_late.py").read_text()
    assert "dataflow capture run.mcap --op bug --firing" in text
    assert "def test_bug_" in text
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "test_late.py exists" in " ".join(again.output.split())
    wrong = CliRunner().invoke(app, [*words, "--overwrite", "--predicate", "out ="])
    assert wrong.exit_code == 2
    assert "no Python expression" in wrong.output
