"""Other operators are a reason against a fix only where it may have changed them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dataflow.graph import load_text
from dataflow.recording import Recording
from dataflow.records.comparison import Difference, Verification
from dataflow.reexecution.recorded_run import graph_that_is_here
from dataflow.tool_server.proof import judge, unmade
from dataflow.verification.report import VerifyReport

OTHER_CPU = (("machine cpu", "one", "another"),)
CHAIN = (
    "graph: bugs\nrecord: {snapshots: 100ms}\noperators:\n"
    "  src: {use: 'zoo.bugs:Numbers', params: {steps: 700}}\n"
    "  sum: {use: 'zoo.bugs:Skips', inputs: {x: src/x}}\n"
    "  sine: {use: 'zoo.bugs:WrongUnit', inputs: {x: sum/out}}\n"
    "  other: {use: 'zoo.bugs:WrongUnit', inputs: {x: src/x}}\n"
)


@pytest.fixture
def wrong(bugs: dict[str, str]) -> Iterator[Recording]:
    with Recording(Path(bugs["wrong"])) as recording:
        yield recording


def differing(operator: str, *, own: bool = True, **more: Any) -> Verification:
    """An operator whose call 3 differs."""
    first = Difference(4, "fire", 0, "out", "aa", "bb")
    return Verification(operator, firings=9, verified=9, first=first, own_fault=own, **more)


def reported(*found: Verification, **more: Any) -> VerifyReport:
    return VerifyReport(found, (), more.pop("facts", ()), 0, 0, 0.0, 0.0, **more)


def test_operator_differing_each_time_or_on_another_machine_is_not_judged(wrong: Recording) -> None:
    graph = graph_that_is_here(wrong)[0]

    others = judge(wrong, reported(differing("sine"), repeated={"sine": False}), graph, "sum")
    assert others.reasons == {}
    assert others.unrepeated == {"sine": "differs each time with the code that was recorded"}

    others = judge(wrong, reported(differing("sine"), repeated={"sine": True}, facts=OTHER_CPU), graph, "sum")
    assert others.reasons == {}
    assert "on another machine than the recorded one (machine cpu one -> another)" in others.unrepeated["sine"]

    others = judge(wrong, reported(differing("sine"), repeated={"sine": True}), graph, "sum")
    told = "culprit: differs alike each time (nothing that the recording holds of it has changed)"
    assert others.reasons == {"sine": told}


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"code_changed": ["gone.module"]}, "code changed: gone.module"),
        ({"files_changed": ["map.json"]}, "files changed: map.json"),
        ({"packages_changed": ["numpy 1 -> 2"]}, "packages changed: numpy 1 -> 2"),
    ],
)
def test_one_that_the_fix_may_have_changed_is_judged(wrong: Recording, more: dict[str, Any], told: str) -> None:
    report = reported(differing("sine", **more), repeated={"sine": False}, facts=OTHER_CPU)

    others = judge(wrong, report, graph_that_is_here(wrong)[0], "sum")

    assert others.unrepeated == {}
    assert others.reasons == {"sine": f"culprit: differs each time ({told})"}


def test_one_with_other_inputs_in_the_graph_is_judged(wrong: Recording) -> None:
    others = judge(wrong, reported(differing("sine"), repeated={"sine": False}), load_text(CHAIN), "sum")

    assert others.reasons == {"sine": "culprit: differs each time (in the graph changed: inputs)"}


def test_one_behind_an_operator_that_does_not_repeat_is_not_judged(wrong: Recording) -> None:
    report = reported(differing("sum"), differing("sine", own=False), repeated={"sum": False})
    graph = load_text(CHAIN)

    assert judge(wrong, report, graph, "other").reasons == {}
    assert judge(wrong, reported(differing("sine", own=False)), graph, "sum").reasons == {}
    assert judge(wrong, reported(differing("sine", own=False)), graph, "other").reasons == {"sine": "downstream"}


def test_nothing_is_proven_of_one_that_is_given_other_messages_than_recorded(wrong: Recording) -> None:
    report = reported(differing("sum"), differing("sine", own=False, tainted=3), repeated={"sum": False})

    others = judge(wrong, report, load_text(CHAIN), "sine")

    assert others.unrepeated.keys() == {"sum"}
    assert others.reasons == {"sine": "is given other messages than recorded, which are made again"}


def test_one_that_writes_into_its_inputs_or_was_not_made_again_is_a_reason(wrong: Recording) -> None:
    graph = graph_that_is_here(wrong)[0]
    report = reported(differing("sine", wrote="src/x #1"), repeated={"sine": False}, absent={"gone": "no module"})

    assert judge(wrong, report, graph, "sum").reasons == {"sine": "culprit", "gone": "not re-executed"}


@pytest.mark.parametrize(
    ("lost", "told"),
    [
        ({}, ""),
        ({"unverifiable": 2, "missing": "x #7"}, "2 of 9 calls could not be made again (x #7 is not recorded)"),
        ({"lost_records": 3}, "3 of 9 calls could not be made again (records before them are missing)"),
        ({"unknown": 1}, "1 of 9 calls could not be made again (their state is not known)"),
    ],
)
def test_calls_not_made_are_reported_with_reason(lost: dict[str, Any], told: str) -> None:
    assert unmade(Verification("sum", firings=9, **lost)) == told
