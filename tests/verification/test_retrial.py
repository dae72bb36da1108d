"""What ran apart is re-executed apart before anything is called a culprit, and what ran together, together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import pytest

from dataflow.graph.load import load_text
from dataflow.records.comparison import Difference, Verification
from dataflow.supervision.run import run
from dataflow.verification.report import VerifyReport
from dataflow.verification.retrial import Trial, retry
from dataflow.verification.verify import verify

Placement = Literal["one_process", "process_each"]


def recorded(path: Path, operators: str, placement: Placement = "process_each", live: bool = False) -> Path:
    """A run of operators (`name: Class`, and parameters) that all take the matrices of one source."""
    lines = ["graph: test", "operators:", "  src: {use: 'sharing_operators:Matrices'}"]
    for line in operators.splitlines():
        name, _, rest = line.strip().partition(": ")
        use, _, more = rest.partition(" ")
        taken = "src/out" if "from" not in more else more.partition("from ")[2]
        params = f"params: {more}" if more.startswith("{") else ""
        fields = [f"use: 'sharing_operators:{use}'", f"inputs: {{x: {taken}}}", params]
        lines.append(f"  {name}: {{{', '.join(filter(None, fields))}}}")
    run(load_text("\n".join(lines)), placement=placement, record=path, live=live)
    return path


def verdicts(report: VerifyReport) -> dict[str, str]:
    return {v.operator: v.verdict for v in report.operators}


@pytest.mark.long
def test_operators_that_share_a_module_are_identical_when_they_ran_apart(tmp_path: Path) -> None:
    report = verify(recorded(tmp_path / "run.mcap", "one: Count\ntwo: Count"), jobs=1)

    assert verdicts(report) == {"one": "identical", "two": "identical"}
    assert report.identical
    assert report.shared == {"one": ("two",), "two": ("one",)}
    assert report.messages == 16


@pytest.mark.long
def test_an_operator_is_no_culprit_for_what_another_one_sets_in_a_library(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "strict: Strict\ndivide: Divide")

    report = verify(path, jobs=1)

    assert report.identical
    assert report.shared == {"divide": ("strict",)}


@pytest.mark.long
@pytest.mark.parametrize("placement", ["process_each", "one_process"])
@pytest.mark.parametrize("jobs", [1, 2])
def test_the_writer_is_the_culprit_and_not_its_readers(tmp_path: Path, jobs: int, placement: Placement) -> None:
    report = verify(recorded(tmp_path / "run.mcap", "solve: Solve\ndouble: Double", placement), jobs=jobs)

    assert verdicts(report) == {"solve": "culprit", "double": "identical"}
    [wrote] = [v.wrote for v in report.operators if v.operator == "solve"]
    assert wrote == "its input 'x' (FeatureVector at stamp 1000000000)"


@pytest.mark.long
def test_one_that_writes_only_later_is_named_where_a_reader_differs(tmp_path: Path) -> None:
    report = verify(recorded(tmp_path / "run.mcap", "solve: Solve {since: 5}\ndouble: Double"), jobs=1)

    assert verdicts(report) == {"solve": "culprit", "double": "identical"}
    assert report.shared == {"double": ("solve",)}


@pytest.mark.long
def test_paranoid_names_it_where_nothing_reads_beside_it(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "solve: Solve {since: 5}")

    assert verdicts(verify(path)) == {"solve": "identical"}
    assert verdicts(verify(path, paranoid=True)) == {"solve": "culprit"}


@pytest.mark.long
def test_a_reader_of_a_message_that_its_maker_changed_in_their_process_is_no_culprit(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "keep: Keep\nlate: Late from keep/out", "one_process")

    report = verify(path, jobs=1)

    assert verdicts(report) == {"keep": "culprit", "late": "identical"}
    assert report.shared == {"late": ("keep",)}


@pytest.mark.long
@pytest.mark.parametrize("since", [0, 5])
def test_one_that_had_a_message_before_and_after_another_wrote_into_it_is_no_culprit(
    tmp_path: Path, since: int
) -> None:
    path = recorded(tmp_path / "run.mcap", f"solve: Solve {{since: {since}}}\nlate: Late", "one_process")

    report = verify(path, jobs=1)

    assert verdicts(report) == {"solve": "culprit", "late": "identical"}
    assert report.shared == {"late": ("solve",)}


@pytest.mark.long
@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("live", [False, True])
def test_operators_that_shared_a_module_in_the_run_are_called_in_its_order(
    tmp_path: Path, jobs: int, live: bool
) -> None:
    path = recorded(tmp_path / "run.mcap", "one: Count\ntwo: Count\nthree: Count from one/out", "one_process", live)

    report = verify(path, jobs=jobs)

    assert verdicts(report) == dict.fromkeys(("one", "two", "three"), "identical")
    assert report.shared.keys() >= {"one", "two"}


@pytest.mark.long
def test_operators_that_shared_a_module_in_the_run_and_differ_apart_are_named_with_those_beside(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "one: Count\ntwo: Count", "one_process")

    report = verify(path, only=["one"])

    assert report.culprits == ("one",)
    assert report.repeats("one")
    assert report.mates == {"one": ("two",)}


def answer(differences: str, got: str = "b") -> dict[str, Any]:
    """What a trial of the operator `clock` shows, which differs from its third call on."""
    found = Verification("clock", firings=9, verified=9, outputs=9, differing=4, differences=differences)
    found.first, found.own_fault = Difference(3, "fire", 30, "out", "a", got), True
    return {"operators": {"clock": asdict(found)}, "reached": {}}


@pytest.mark.parametrize(
    ("again", "repeats"), [(answer("1"), True), (answer("2"), False), (answer("1", got="c"), False)]
)
def test_an_operator_repeats_only_where_all_that_differs_is_the_same(again: dict[str, Any], repeats: bool) -> None:
    asked: list[Trial] = []

    def attempt(trials: Sequence[Trial]) -> list[dict[str, Any]]:
        asked.extend(trials)
        return [again] * len(trials)

    found = retry(["clock"], {"clock": answer("1")}, {"clock": frozenset({"clock"})}, attempt)

    assert found.repeated == {"clock": repeats}
    assert asked[0] == Trial(frozenset({"clock"}), {"clock": (0, 3, "b")})


@pytest.mark.parametrize(("since", "downstream"), [(20, True), (30, True), (31, False)])
def test_a_message_that_was_written_into_counts_where_it_came_before_the_difference(
    since: int, downstream: bool
) -> None:
    again = {**answer("1"), "reached": {"clock": ["writer", since]}}

    found = retry(["clock"], {"clock": answer("1")}, {"clock": frozenset({"clock"})}, lambda trials: [again])

    assert found.overwritten == ({"clock": "writer"} if downstream else {})
    assert found.repeated == ({} if downstream else {"clock": True})


def test_a_parameter_that_another_graph_changes_is_named(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "solve: Solve {since: 5}", "one_process")
    text = "graph: test\noperators:\n  src: {use: 'sharing_operators:Matrices'}\n"
    text += "  solve: {use: 'sharing_operators:Solve', inputs: {x: src/out}, params: {since: 6}}"

    report = verify(path, graph=load_text(text), only=["solve"])

    assert report.changes == {"solve": ("parameter since 5 → 6",)}
    assert report.altered("solve") == ("parameter since 5 → 6",)
