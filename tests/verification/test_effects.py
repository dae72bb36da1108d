"""A graph that asks a service verifies with the service stopped, whole and in parts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import vision_language
from typer.testing import CliRunner

from dataflow.api.runs import replay
from dataflow.api.runs import run as run_here
from dataflow.cli.main import app
from dataflow.debugging.debugger import Debugger
from dataflow.recording import Recording
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import recorded_firings
from dataflow.supervision.run import run
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded run; the service has stopped since."""
    path = tmp_path_factory.mktemp("asked") / "run.mcap"
    with vision_language.service() as url:
        run(vision_language.graph(url), record=path)
    return path


def effects(report: VerifyReport) -> dict[str, int]:
    [found] = [v.effects for v in report.operators]
    return found["ask"]


def records(path: Path) -> list[FiringRecord]:
    with Recording(path) as recording:
        return list(recorded_firings(recording, "describe"))


def calls(path: Path) -> list[list[Any]]:
    return [call for record in records(path) for call in record.detail.get("effects", [0, []])[1]]


def url_of(path: Path) -> str:
    return str(records(path)[0].detail["params"]["url"])


def invoke(*words: object, code: int = 0) -> str:
    done = CliRunner().invoke(app, [*map(str, words)])
    assert done.exit_code == code, done.output
    return done.stdout


def test_a_run_is_identical_without_the_service(asked: Path) -> None:
    report = verify(asked)

    assert report.identical
    assert effects(report) == {"given": 12, "missed": 0, "again": 0, "same": 0}
    assert "describe: 12 answers of ask given as recorded" in invoke("verify", asked, "--quiet")


@pytest.mark.long
@pytest.mark.timeout(400)
def test_twenty_runs_of_twenty_are_identical_without_the_service(tmp_path: Path) -> None:
    """With errors and timeouts among the answers, and no two runs alike."""
    with vision_language.service() as url:
        for k in range(20):
            run_here(vision_language.graph(url, views=8), record=tmp_path / f"{k}.mcap")

    told = json.loads(invoke("verify", tmp_path, "--quiet", "--json"))

    assert [one["verdict"] for one in told["recordings"]] == ["identical"] * 20
    made = [effect for k in range(20) for effect in calls(tmp_path / f"{k}.mcap")]
    assert len(made) == 160
    errors = [data for _, _, raised, data in made if raised]
    assert any(b"TimeoutError" in data for data in errors)
    assert any(b"503" in data for data in errors)
    assert len({one[3] for one in made if not one[2]}) > 60


def test_a_changed_prompt_is_a_miss_with_call_and_line(asked: Path, tmp_path: Path) -> None:
    changed = vision_language.graph(url_of(asked), prompt="What is on the floor?")

    report = verify(asked, graph=changed)

    assert report.culprits == ("describe",)
    [found] = report.operators
    assert found.first is not None
    source = Path(vision_language.__file__).read_text().splitlines()
    line = next(n for n, text in enumerate(source, 1) if "self.effect(" in text)
    assert f"miss at effect 0 (vision_language.py:{line}), ask: argument 1 differs" in found.first.got


def test_the_debugger_goes_to_a_miss_and_asks_on_demand(asked: Path) -> None:
    changed = vision_language.graph(url_of(asked), prompt="What is on the floor?")
    with Recording(asked) as recording:
        debugger = Debugger(recording, "describe", changed)
        found = debugger.first_difference()
        assert found is not None
        assert found.number == 0
        assert "EffectMiss: miss at effect 0" in (found.error or "")
        debugged = Debugger(recording, "describe", changed, make_effects=True).goto(0)
        [made] = debugged.made
        assert "URLError" in made.here.text


@pytest.mark.long
def test_parts_of_a_recording_keep_the_answers(asked: Path, tmp_path: Path) -> None:
    cut, parts, merged = tmp_path / "cut.mcap", tmp_path / "parts", tmp_path / "merged.mcap"
    invoke("cut", asked, "--from", "0.55", "--to", "0.95", "--out", cut, "--quiet")
    invoke("split", asked, "--every", "0.6", "--out", parts, "--quiet")
    files = sorted(parts.glob("*.mcap"))
    invoke("merge", *files, "--out", merged, "--quiet")

    for path in cut, *files, merged:
        [found] = verify(path).operators
        assert found.verdict == "identical", path
        assert found.effects["ask"]["given"] == sum("effects" in record.detail for record in records(path)) > 0
        assert found.effects["ask"]["missed"] == 0
    numbers = [record.detail["effects"][0] for record in records(cut) if "effects" in record.detail]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert numbers[0] > 0


def test_calls_are_made_again_on_demand_and_their_repeatability_is_reported(asked: Path) -> None:
    told = invoke("verify", asked, "--make-effects", "--quiet")

    assert "made again 12 times, 0 answered as recorded" in told  # the service is gone


def test_a_replay_asks_the_service(asked: Path, tmp_path: Path) -> None:
    path = tmp_path / "replayed.mcap"
    replay(asked, record=path)

    made = calls(path)
    assert len(made) == 12
    assert all(raised and b"URLError" in data for _, _, raised, data in made)
    assert verify(path).identical


@pytest.mark.long
def test_a_replay_that_begins_in_the_middle_has_the_recorded_answers_before(asked: Path, tmp_path: Path) -> None:
    path = tmp_path / "replayed.mcap"
    invoke("replay", asked, "--start", "0.75", "--one-process", "--record", path, "--quiet")

    [restored] = [record for record in records(path) if record.kind == "restore"]
    assert restored.detail["state"] is not None
    assert verify(path).identical


@pytest.mark.long
def test_repeated_verification_gives_the_odds(asked: Path) -> None:
    told = invoke("verify", asked, "--repeat", "3", "--quiet")
    as_json = json.loads(invoke("verify", asked, "--repeat", "2", "--quiet", "--json"))

    assert "a difference was not seen in 3 runs: at most 63.2% of runs, at 95 % confidence" in told
    assert as_json["runs"] == 2
    assert as_json["unseen"] == pytest.approx(1 - 0.05**0.5)
