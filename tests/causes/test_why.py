"""`verify --why` names causes and lines in a recording, and refuses where there is nothing to find or to run."""

from __future__ import annotations

import io
import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zoo.faulty
from rich.console import Console
from typer.testing import CliRunner

from dataflow.api.runs import run
from dataflow.causes.ladder import Findings
from dataflow.causes.rerun import Rerun, fake_time
from dataflow.causes.traps import Site
from dataflow.causes.why import Cause, CauseReport, _Alone, _answer, refusal, why
from dataflow.cli.commands.verification import _may_be_a_test
from dataflow.cli.main import app
from dataflow.cli.support.causes import print_reasons
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


@pytest.mark.long
@pytest.mark.skipif(not fake_time(), reason="libfaketime (the [dev] extra) is not installed")
def test_a_clock_that_compiled_code_reads_is_named(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "Compiled")

    found = why(path, verify(path), "Compiled")

    assert [cause.kind for cause in found.causes] == ["clock read by compiled code or at an import"]
    assert found.reruns <= 8


def test_the_line_that_writes_into_an_input_is_named(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "Writes")

    shown: list[tuple[str, int, str]] = []
    found = why(path, verify(path), "Writes", progress=lambda *told: shown.append(told))

    assert shown == [("Writes", 1, "its lines are watched")]
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
def test_search_for_causes_refuses_repeating_or_unrunnable_operators(
    found: Verification, more: dict[str, Any], reason: str
) -> None:
    made = report(found, **more)

    assert refusal(made, "x", next((v for v in made.operators if v.operator == "x"), None)) == reason


@pytest.mark.parametrize(
    ("newer", "revised", "causes", "also"),
    [
        (True, False, {"folder"}, {"environment variable"}),
        (False, False, {"environment variable"}, {"folder"}),
        (True, True, {"folder"}, {"environment variable"}),
        (False, True, set(), {"folder", "environment variable"}),
    ],
)
def test_possibly_unchanged_sources_are_no_cause_if_code_or_files_changed(
    newer: bool, revised: bool, causes: set[str], also: set[str]
) -> None:
    findings = Findings(Rerun(("",)), repeats=True, causes=["folder:models", "environment variable:GAIN"])
    alone: Any = SimpleNamespace(is_newer=lambda file, found: newer)

    found = _answer(findings, alone, None, Verification("x"), revised)

    assert {cause.kind for cause in found.causes} == causes
    assert {cause.kind for cause in found.also} == also
    assert {cause["cause"] for cause in found.as_json()["also"]} == also


def test_nondeterminism_is_a_cause_though_the_code_changed() -> None:
    findings = Findings(Rerun(("",)), repeats=False, settled=True, causes=["wall clock"])

    assert _answer(findings, None, None, Verification("x"), revised=True).causes


def test_facts_of_the_machine_are_no_change_of_an_operator() -> None:
    found = Verification("x", code_changed=["op"], packages_changed=["numpy 1 → 2"])
    made = report(found)
    made = replace(made, facts=(("cpu", "a", "b"),))

    assert made.revised("x") == ("code of op", "numpy 1 → 2")
    assert made.altered("x") == ("code of op", "numpy 1 → 2", "cpu: a → b")


def test_file_copied_with_its_times_is_newer_than_an_earlier_recording(tmp_path: Path) -> None:
    copied = tmp_path / "cfg.json"
    copied.write_text("{}")
    os.utime(copied, (1.0, 1.0))
    alone: Any = SimpleNamespace(recorded=copied.stat().st_ctime - 1)

    assert _Alone.is_newer(alone, str(copied), Verification("x"))
    alone.recorded += 2
    assert not _Alone.is_newer(alone, str(copied), Verification("x"))


def test_changed_code_is_reported_before_other_dependencies() -> None:
    gain = Cause("environment variable:GAIN", (Site("/robot/op.py", 20, "setup", "os.environ"),), 1)
    console = Console(file=io.StringIO(), width=200)

    print_reasons(console, "", [CauseReport("x", repeats=True, changed=("code of op",), also=(gain,))])

    assert console.file.getvalue().splitlines() == [
        "x: it repeats here, and this is not as it was recorded (0 re-runs, 0.00 s)",
        "x: not as it was recorded: code of op",
        "x: its results also depend on environment variable GAIN (op.py:20), not known for the recording",
    ]


@pytest.mark.parametrize(
    ("found", "repeats", "reasons", "advised"),
    [
        ({"code_changed": ["op"]}, True, None, True),
        ({"code_changed": ["op"]}, False, None, False),
        ({}, True, None, False),  # as it was recorded: what differs is not known, and may differ by chance
        ({"code_known": False}, True, None, True),
        ({}, True, CauseReport("x", repeats=True, causes=(Cause("environment variable:GAIN"),)), True),
        ({}, True, CauseReport("x", repeats=True, causes=(Cause("monotonic clock"),)), False),
        ({"code_changed": ["op"]}, True, CauseReport("x", repeats=True, also=(Cause("wall clock"),)), False),
        ({"code_changed": ["op"]}, True, CauseReport("x", repeats=False, settled=True), False),
    ],
)
def test_a_test_is_advised_of_calls_that_differ_and_not_by_chance(
    found: dict[str, Any], repeats: bool, reasons: CauseReport | None, advised: bool
) -> None:
    made = report(Verification("x", first=DIFFERENCE, own_fault=True, **{"code_known": True} | found))
    made = replace(made, repeated={"x": repeats})

    assert _may_be_a_test(made, "x", [] if reasons is None else [[reasons]]) == advised


def test_sources_of_chance_that_it_reads_in_vain_are_listed_before_devices() -> None:
    site = Site("/robot/op.py", 60, "process", "time.monotonic")
    findings = Findings(Rerun(("",), sites=(("monotonic clock", site, 40),)), repeats=True, reruns=5)
    findings.cleared = ["monotonic clock", "random"]
    console = Console(file=io.StringIO(), width=200)

    found = _answer(findings, None, None, Verification("x"), revised=False)
    print_reasons(console, "", [found])

    first, second = console.file.getvalue().splitlines()
    assert first == "x: reads the monotonic clock at op.py:60; no effect seen in 5 re-runs"
    assert "may have changed (what it reads, as above, may show in few runs; files that C libraries read" in second
    assert [read["calls"] for read in found.as_json()["reads"]] == [40]


def test_an_operator_that_is_refused_is_not_run(tmp_path: Path) -> None:
    made = report(Verification("x", firings=1, verified=1))

    assert why(tmp_path / "no.mcap", made, "x").refused == "it repeats: identical"
