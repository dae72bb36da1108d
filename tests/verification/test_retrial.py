"""What ran apart is re-executed apart before anything is called a culprit, and what ran together, together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import pytest
from zoo.cages import CAGES

from dataflow.graph.load import load_text
from dataflow.records.comparison import Difference, Verification
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.run import run
from dataflow.verification.report import VerifyReport
from dataflow.verification.retrial import Trial, retry
from dataflow.verification.verify import verify

Placement = Literal["one_process", "process_each"]
SOURCE = "  src: {use: 'zoo.operators:Steps', params: {steps: 8}}"


def recorded(path: Path, operators: str, placement: Placement = "process_each", live: bool = False) -> Path:
    """A run of operators (`name: Class`, and parameters) that all take the matrices of one source."""
    lines = ["graph: test", "operators:", SOURCE]
    for line in operators.splitlines():
        name, _, rest = line.strip().partition(": ")
        use, _, more = rest.partition(" ")
        taken = "src/out" if "from" not in more else more.partition("from ")[2]
        params = f"params: {more}" if more.startswith("{") else ""
        fields = [f"use: 'zoo.operators:{use}'", f"inputs: {{x: {taken}}}", params]
        lines.append(f"  {name}: {{{', '.join(filter(None, fields))}}}")
    run(load_text("\n".join(lines)), placement=placement, record=path, live=live)
    return path


def verdicts(report: VerifyReport) -> dict[str, str]:
    return {v.operator: v.verdict for v in report.operators}


COUNTS = "one: Count\ntwo: Count"
WROTE = "its input 'x' (FeatureVector at stamp 1000000000000000000)"


@pytest.mark.long
@pytest.mark.parametrize(
    ("operators", "placement", "jobs", "culprit", "shared"),
    [
        (COUNTS, "process_each", 1, "", {"one": ("two",), "two": ("one",)}),  # they count in their module
        ("strict: Strict\ndivide: Divide", "process_each", 1, "", {"divide": ("strict",)}),  # one sets a library
        ("solve: Overwrite\ndouble: Hard", "process_each", 1, "solve", None),  # it writes into what both are given
        ("solve: Overwrite\ndouble: Hard", "process_each", 2, "solve", None),
        ("solve: Overwrite\ndouble: Hard", "one_process", 1, "solve", None),
        ("solve: Overwrite\ndouble: Hard", "one_process", 2, "solve", None),
        ("solve: Overwrite {since: 5}\ndouble: Hard", "process_each", 1, "solve", {"double": ("solve",)}),
        # into a message that it made before
        ("keep: KeepsEmitted\nlate: Before from keep/out", "one_process", 1, "keep", {"late": ("keep",)}),
        ("solve: Overwrite {since: 0}\nlate: Before", "one_process", 1, "solve", {"late": ("solve",)}),
        # the reader had the message before and after
        ("solve: Overwrite {since: 5}\nlate: Before", "one_process", 1, "solve", {"late": ("solve",)}),
    ],
)
def test_only_operator_that_writes_into_messages_is_culprit(
    operators: str,
    placement: Placement,
    jobs: int,
    culprit: str,
    shared: dict[str, tuple[str, ...]] | None,
    tmp_path: Path,
) -> None:
    report = verify(recorded(tmp_path / "run.mcap", operators, placement), jobs=jobs)

    names = [line.partition(":")[0] for line in operators.splitlines()]
    assert verdicts(report) == {name: "culprit" if name == culprit else "identical" for name in names}
    assert report.identical == (not culprit)
    assert shared is None or report.shared == shared
    if shared is None:
        assert [v.wrote for v in report.operators if v.operator == culprit] == [WROTE]


@pytest.mark.long
def test_paranoid_finds_writer_without_other_readers(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "solve: Overwrite {since: 5}")

    assert verdicts(verify(path)) == {"solve": "identical"}
    assert verdicts(verify(path, paranoid=True)) == {"solve": "culprit"}


@pytest.mark.long
@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("live", [False, True])
def test_operators_that_shared_a_module_are_called_in_order_of_run(tmp_path: Path, jobs: int, live: bool) -> None:
    path = recorded(tmp_path / "run.mcap", f"{COUNTS}\nthree: Count from one/out", "one_process", live)

    report = verify(path, jobs=jobs)

    assert verdicts(report) == dict.fromkeys(("one", "two", "three"), "identical")
    assert report.shared.keys() >= {"one", "two"}


@pytest.mark.long
def test_operator_that_differs_apart_is_named_with_its_mates(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", COUNTS, "one_process")

    report = verify(path, only=["one"])

    assert report.culprits == ("one",)
    assert report.repeats("one")
    assert report.mates == {"one": ("two",)}


@pytest.mark.long
def test_hard_operators_in_one_process_get_the_right_verdicts(tmp_path: Path) -> None:
    """`benchmarks/verdicts.py` runs them in all ways."""
    cage = CAGES["each for itself"]
    with pytest.raises(RunFailed, match="it does not close"):
        run(cage.graph(), placement="one_process", record=tmp_path / "run.mcap")

    report = verify(tmp_path / "run.mcap")

    assert {v.operator: report.verdict(v) for v in report.operators} == cage.together
    assert report.repeated == {name: False for name, verdict in cage.together.items() if verdict == "culprit"}
    assert not report.shared


def answer(differences: str, got: str = "b") -> dict[str, Any]:
    """What a trial of the operator `clock` shows, which differs from its third call on."""
    found = Verification("clock", firings=9, verified=9, outputs=9, differing=4, differences=differences)
    found.first, found.own_fault = Difference(3, "fire", 30, "out", "a", got), True
    return {"operators": {"clock": asdict(found)}, "reached": {}}


@pytest.mark.parametrize(
    ("again", "repeats"), [(answer("1"), True), (answer("2"), False), (answer("1", got="c"), False)]
)
def test_operator_repeats_only_if_all_differences_are_equal(again: dict[str, Any], repeats: bool) -> None:
    asked: list[Trial] = []

    def attempt(trials: Sequence[Trial]) -> list[dict[str, Any]]:
        asked.extend(trials)
        return [again] * len(trials)

    found = retry(["clock"], {"clock": answer("1")}, {"clock": frozenset({"clock"})}, attempt)

    assert found.repeated == {"clock": repeats}
    assert asked[0] == Trial(frozenset({"clock"}), {"clock": (0, 3, "b")})


@pytest.mark.parametrize(("since", "downstream"), [(20, True), (30, True), (31, False)])
def test_overwritten_message_counts_only_before_first_difference(since: int, downstream: bool) -> None:
    again = {**answer("1"), "reached": {"clock": ["writer", since]}}

    found = retry(["clock"], {"clock": answer("1")}, {"clock": frozenset({"clock"})}, lambda trials: [again])

    assert found.overwritten == ({"clock": "writer"} if downstream else {})
    assert found.repeated == ({} if downstream else {"clock": True})


def test_changed_parameter_is_named(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", "solve: Overwrite {since: 5}", "one_process")
    text = f"graph: test\noperators:\n{SOURCE}\n"
    text += "  solve: {use: 'zoo.operators:Overwrite', inputs: {x: src/out}, params: {since: 6}}"

    report = verify(path, graph=load_text(text), only=["solve"])

    assert report.changes == {"solve": ("parameter since 5 → 6",)}
    assert report.altered("solve") == ("parameter since 5 → 6",)
