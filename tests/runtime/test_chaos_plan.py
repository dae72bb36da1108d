"""A fault plan is the same timeline for the same seed, and refuses what could not be done."""

from __future__ import annotations

from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.chaos.faults import SourceFaults
from dataflow.chaos.plan import ChaosError, Fault, load_plan, plan_of
from dataflow.graph import Graph, load_graph
from dataflow.messages import FeatureVector, Message

HERE = Path(__file__).resolve().parent
KILL = {"kind": "kill", "operator": "smooth", "every": "700ms"}
TUNE = {"kind": "param", "operator": "tuned", "name": "factor", "values": [0.5, 1.0, 2.0], "every": "200ms"}
SLOW = {"kind": "slow", "operator": "mix", "by": "30ms", "for": "200ms", "at": "1s"}


@pytest.fixture(scope="module")
def graph() -> Graph:
    return load_graph(HERE / "chaos.yaml", live=True)


def timeline(graph: Graph, *entries: dict[str, Any], seed: int = 1, until: float = 20.0) -> list[Fault]:
    return list(takewhile(lambda fault: fault.at < until, plan_of({"faults": list(entries)}, graph, seed=seed)))


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_a_seed_is_a_timeline_and_another_seed_another(graph: Graph, seed: int) -> None:
    assert timeline(graph, KILL, TUNE, SLOW, seed=seed) == timeline(graph, KILL, TUNE, SLOW, seed=seed)
    assert timeline(graph, KILL, TUNE, SLOW, seed=seed) != timeline(graph, KILL, TUNE, SLOW, seed=seed + 1)


def test_the_timeline_is_in_the_order_of_time_and_as_dense_as_asked(graph: Graph) -> None:
    faults = timeline(graph, KILL, TUNE, SLOW, until=200.0)

    assert [f.at for f in faults] == sorted(f.at for f in faults)
    kills = [f.at for f in faults if f.kind == "kill"]
    assert np.mean(np.diff(kills)) == pytest.approx(0.7, rel=0.2)
    assert {f.fields["value"] for f in faults if f.kind == "param"} == {0.5, 1.0, 2.0}
    assert [f for f in faults if f.kind == "slow"] == [Fault(1.0, "slow", "mix", {"by": 0.03, "span": 0.2})]


def test_entry_is_independent_of_later_entries(graph: Graph) -> None:
    alone = timeline(graph, KILL)
    together = timeline(graph, KILL, TUNE, SLOW)

    assert [f for f in together if f.kind == "kill"] == alone
    assert timeline(graph, {**KILL, "until": "5s"}) == [f for f in alone if f.at <= 5.0]


def test_seed_of_a_plan_file_may_be_overridden(graph: Graph, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text("seed: 3\nfaults:\n  - {kind: kill, operator: smooth, every: 700ms}\n")

    first = list(islice(load_plan(path, graph), 5))
    assert first == list(islice(plan_of({"seed": 3, "faults": [KILL]}, graph), 5))
    assert first != list(islice(load_plan(path, graph, seed=4), 5))


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({**KILL, "operator": "smoth"}, "faults.0.operator: no operator 'smoth'; did you mean 'smooth'?"),
        ({**KILL, "kind": "burn"}, "faults.0.kind: no kind of fault 'burn'; there are: kill, raise, hang, freeze"),
        ({"operator": "smooth", "at": "1s"}, "faults.0: 'kind' is missing; there are kill, raise"),
        ({**KILL, "at": "1s"}, "faults.0: give either 'at' (once) or 'every' (again and again)"),
        ({**KILL, "every": "soon"}, "faults.0.every: duration 'soon': expected a number and a unit"),
        ({**KILL, "every": 3}, "faults.0.every: a duration has a unit, such as 100ms"),
        ({**KILL, "every": "0s"}, "faults.0.every: Input should be greater than 0, got '0s'"),
        ({**SLOW, "operator": "left"}, "'slow' is for operators with inputs; 'left' is a source"),
        ({"kind": "slow", "operator": "mix", "for": "1s", "at": "1s"}, "faults.0: 'by' is missing"),
        ({"kind": "stop", "operator": "mix", "for": "1s", "at": "1s"}, "'stop' is for sources (left, right)"),
        ({"kind": "hang", "operator": "mix", "at": "1s"}, "nothing would notice that 'mix' hangs; give it live: {dead"),
        ({"kind": "flood", "operator": "left", "factor": 1, "for": "1s", "at": "1s"}, "greater than or equal to 2"),
        ({**TUNE, "name": "factr"}, "faults.0.name: 'tuned' has no parameter 'factr'; did you mean 'factor'?"),
        ({**TUNE, "operator": "slow", "name": "sleep"}, "'sleep' of 'slow' cannot change while the graph runs; "),
        ({**TUNE, "values": [1.0, 1e9]}, "faults.0.values.1: Tuned.factor: Input should be less than or equal to"),
        ({"kind": "malformed", "operator": "left", "at": "1s", "size": 3}, "faults.0.size: unknown key 'size'"),
    ],
)
def test_invalid_plan_error_names_the_entry_and_reason(graph: Graph, entry: Any, words: str) -> None:
    with pytest.raises(ChaosError) as caught:
        plan_of({"faults": [entry]}, graph)
    assert words in str(caught.value)


def test_fatal_fault_without_restart_policy_is_refused() -> None:
    fragile = load_graph(HERE / "live.yaml", live=True)

    with pytest.raises(ChaosError, match="'kill' would end the run; give 'smooth' a restart policy"):
        plan_of({"faults": [KILL]}, fragile)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "plan.yaml:1:1: a fault plan is a mapping"),
        (b"faults: [", "plan.yaml:1:10: not readable as YAML"),
        (b"seed: x\nfaults: []", "plan.yaml:1:7: Input should be a valid integer"),
        (b"\xff\xfe", "plan.yaml: 'utf-8' codec"),
        (
            b"faults:\n  - {kind: kill, operator: smooth, at: 1s}\n"
            b"  - {kind: param, operator: tuned, name: factor, values: [1, 1000000], at: 1s}\n",
            "plan.yaml:3:62: Tuned.factor: Input should be less than or equal to",
        ),
    ],
)
def test_a_plan_file_that_cannot_be_followed_is_named_with_the_line(
    graph: Graph, tmp_path: Path, text: bytes, words: str
) -> None:
    path = tmp_path / "plan.yaml"
    path.write_bytes(text)

    with pytest.raises(ChaosError) as caught:
        load_plan(path, graph)
    assert words in str(caught.value)


def test_a_plan_file_that_is_not_there_is_named(graph: Graph, tmp_path: Path) -> None:
    with pytest.raises(ChaosError, match=r"nowhere\.yaml"):
        load_plan(tmp_path / "nowhere.yaml", graph)


def step(stamp: int) -> dict[str, Message]:
    return {"fast": FeatureVector(stamp=stamp, vectors=np.zeros((1, 1), np.float32), model="test")}


def stamps(faults: SourceFaults, stamp: int, now: float) -> list[int]:
    return [made["fast"].stamp for made in faults.apply(step(stamp), now)]


@given(st.integers(0, 10**12), st.floats(0, 1e6))
def test_a_source_that_nothing_is_done_to_is_left_alone(stamp: int, now: float) -> None:
    assert stamps(SourceFaults(), stamp, now) == [stamp]


def test_source_faults_end_on_time() -> None:
    faults = SourceFaults()
    faults.begin("stop", {"span": 1.0}, 10.0)
    assert [stamps(faults, 5, t) for t in (10.0, 10.9, 11.1)] == [[], [], [5]]
    faults.begin("flood", {"factor": 3, "span": 1.0}, 20.0)
    assert [stamps(faults, 5, t) for t in (20.5, 21.5)] == [[5, 6, 7], [5]]
    faults.begin("past", {"by": 2e-9, "back": True}, 30.0)
    assert [stamps(faults, 5, 30.0), stamps(faults, 6, 30.0)] == [[3, 5], [6]]
    faults.begin("jump", {"by": 3e-9, "back": True}, 40.0)
    faults.begin("jump", {"by": 1e-9, "back": False}, 40.0)
    assert [stamps(faults, k, 40.0) for k in (7, 1)] == [[5], [0]]  # never before the epoch
