"""`verify --why` names causes and lines in a recording, and refuses where there is nothing to find or to run."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zoo.faulty
from typer.testing import CliRunner

from dataflow.api.runs import run
from dataflow.causes.ladder import Findings
from dataflow.causes.rerun import Rerun
from dataflow.causes.why import _answer, refusal, why
from dataflow.cli.main import app
from dataflow.graph import load_text
from dataflow.records.comparison import Difference, Verification
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

LINES = Path(zoo.faulty.__file__).read_text().splitlines()


def recorded(path: Path, *operators: str) -> Path:
    lines = ["graph: zoo", "operators:", "  src: {use: 'zoo.operators:Steps', params: {steps: 6}}"]
    lines += [f"  {name}: {{use: 'zoo.faulty:{name}', inputs: {{x: src/out}}}}" for name in operators]
    run(load_text("\n".join(lines)), record=path)
    return path


def line_of(site: Any) -> str:
    return str(LINES[site["line"] - 1]).strip()


@pytest.mark.long
def test_the_command_names_two_causes_at_once_with_their_lines(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "Two")

    told = CliRunner().invoke(app, ["verify", str(path), "--why", "--json", "--quiet"])

    assert told.exit_code == 1
    [answer] = json.loads(told.stdout)["why"]
    assert answer["operator"] == "Two"
    assert not answer["repeats"]
    assert answer["settled"]
    assert {cause["cause"] for cause in answer["causes"]} == {"wall clock", "entropy of the system"}
    for cause in answer["causes"]:
        assert [line_of(site) for site in cause["sites"]] == ["return [time.time() % 1000, float(os.urandom(1)[0])]"]
        assert cause["calls"] == 6
    assert answer["reruns"] <= 8


def test_the_line_that_writes_into_an_input_is_named(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "Writes")

    found = why(path, verify(path), "Writes")

    [cause] = found.causes
    assert cause.kind == "input written to"
    assert [LINES[site.line - 1].strip() for site in cause.sites] == ["rows += 1"]
    assert found.reruns == 1


def report(verification: Verification, **more: Any) -> VerifyReport:
    return VerifyReport((verification,), (), (), 0, 0, 0.0, 0.0, **more)


DIFFERENCE = Difference(0, "fire", 1, "out", "a", "b")


@pytest.mark.parametrize(
    ("found", "more", "reason"),
    [
        (Verification("x", firings=1, verified=1), {}, "it repeats: identical"),
        (Verification("x", first=DIFFERENCE), {}, "its inputs differ: look at the culprits before it"),
        (Verification("x", unverifiable=2, missing="src/out #3"), {}, "it cannot be run again: src/out #3"),
        (Verification("y"), {"absent": {"x": "no module lost"}}, "it cannot be run again: no module lost"),
        (Verification("y"), {}, "it was not verified: a source or external operator is not run again"),
        (Verification("x", first=DIFFERENCE, own_fault=True), {}, ""),
    ],
)
def test_what_repeats_or_cannot_be_run_again_is_refused(found: Verification, more: dict[str, Any], reason: str) -> None:
    made = report(found, **more)

    assert refusal(made, "x", next((v for v in made.operators if v.operator == "x"), None)) == reason


@pytest.mark.parametrize(("newer", "causes", "older"), [(True, 2, 0), (False, 1, 1)])
def test_a_folder_is_a_cause_only_where_it_was_changed_since_the_recording(
    newer: bool, causes: int, older: int
) -> None:
    findings = Findings(Rerun(("",)), repeats=True, causes=["folder:models", "environment variable:GAIN"])
    alone: Any = SimpleNamespace(is_newer=lambda file, found: newer)

    found = _answer("x", findings, alone, None, Verification("x"))

    assert (len(found.causes), len(found.older)) == (causes, older)


def test_an_operator_that_is_refused_is_not_run(tmp_path: Path) -> None:
    made = report(Verification("x", firings=1, verified=1))

    assert why(tmp_path / "no.mcap", made, "x").refused == "it repeats: identical"
