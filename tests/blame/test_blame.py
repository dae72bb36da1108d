"""The chain that is found is the one that is known: what must have decided a value, and nothing that cannot have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import blamed_graphs
import held_runs
import numpy as np
import pytest

import dataflow
from dataflow.blame import chain as chain_module
from dataflow.blame.chain import Blame, BlameError
from dataflow.blame.field import Field, differ
from dataflow.blame.line import Line
from dataflow.blame.links import Chain
from dataflow.blame.nudge import groups, nudged
from dataflow.graph import Graph, load_text
from dataflow.graph.model import Node
from dataflow.messages import Detections2D, FeatureVector, Pose
from dataflow.recording import Recording
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog

HOUR = 3600 * 10**9
TWO = ("keep | Keep | x: src/a, flag: src/b", "scale | Scale | x: keep/out")
KEEPS = 85
"""The seed of a graph without selections before a state, of which the value is two calls old."""


def blamed(path: Path, field: str, graph: Graph | None = None, budget: float = 600.0) -> Chain:
    with Recording(path) as recording:
        return Blame(recording, Field.parse(field), graph, budget=budget).find()


def found(case: blamed_graphs.Case, path: Path, budget: float = 600.0) -> Chain:
    return blamed(path, case.field, budget=budget)


def ran(path: Path, *operators: str) -> Path:
    """Records a run of the sensors and operators."""
    dataflow.run(blamed_graphs.graph_of(*operators), record=path)
    return path


def sensed(chain: Chain) -> set[blamed_graphs.Sensed]:
    return {(link.message[0].rpartition("/")[2], link.message[2]) for link in chain.sensed if link.message}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[blamed_graphs.Case, Path]:
    case = blamed_graphs.case(KEEPS)
    return case, blamed_graphs.recorded(case, tmp_path_factory.mktemp("kept") / "run.mcap")


def test_the_chain_goes_back_through_operators_and_their_earlier_calls(kept: tuple[blamed_graphs.Case, Path]) -> None:
    case, path = kept

    chain = found(case, path)

    assert chain.whole
    assert chain.value == pytest.approx(case.truth.value)
    assert case.truth.must <= sensed(chain) <= case.truth.must | case.truth.may
    assert [link for link in chain.links if not link.input and link.maker and link.maker[0] == link.call[0]]


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 8, 14])
def test_the_chain_of_a_made_graph_is_the_true_one(seed: int, tmp_path: Path) -> None:
    case = blamed_graphs.case(seed)

    chain = found(case, blamed_graphs.recorded(case, tmp_path / "run.mcap"))

    assert chain.whole
    assert case.truth.must <= sensed(chain) <= case.truth.must | case.truth.may


def test_calls_left_out_for_lack_of_time_are_named(kept: tuple[blamed_graphs.Case, Path]) -> None:
    chain = found(*kept, budget=1e-9)

    assert not chain.whole
    assert chain.left == [chain.target]


def test_the_inputs_of_all_operators_together_are_bounded(two: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = Field.parse(blamed_graphs.at(40, "scale/out"))
    monkeypatch.setattr("dataflow.blame.line.AHEAD", 0)

    with Recording(two) as recording:
        monkeypatch.setattr(chain_module, "MOST_BYTES", 8)
        chain = Blame(recording, field).find()
        monkeypatch.setattr(chain_module, "MOST_BYTES", 1)
        with pytest.raises(BlameError, match="the inputs of call 40 of scale take more than 1 bytes"):
            Blame(recording, field).find()

    assert chain.left == [("keep", 40)]


@pytest.mark.parametrize(
    ("field", "problem"),
    [
        ("o9/out.vectors@3", "'o9/out' is no stream; there are: blamed/src/a"),
        ("out.vectors@3", "'out' is several streams; there are: blamed/o0/out"),
        ("src/a.vectors@3", "blamed/src/a is what src gave, a source"),
        ("o2/out.vectors[7]@3", "has no vectors[7]"),
        ("o2/out.vectors@-1", "expected STREAM.FIELD@SECONDS"),
        ("o2/out.vectors[@1", "'[' was never closed"),
    ],
)
def test_unknown_value_is_refused(kept: tuple[blamed_graphs.Case, Path], field: str, problem: str) -> None:
    with pytest.raises((BlameError, ValueError)) as caught:
        blamed(kept[1], field)

    assert problem in str(caught.value)


def test_changed_code_is_refused(kept: tuple[blamed_graphs.Case, Path]) -> None:
    case, path = kept
    other = load_text(case.text.replace("blamed_graphs:Keep", "blamed_graphs:KeepHalf"))

    with pytest.raises(BlameError, match="does not give what was recorded"):
        blamed(path, case.field, other)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ran(tmp_path_factory.mktemp("two") / "run.mcap", *TWO)


@pytest.mark.parametrize(
    ("other", "problem"), [("KeepHalf", "does not give what was"), ("Unsteady", "does not repeat")]
)
def test_changed_or_unsteady_code_upstream_is_refused(two: Path, other: str, problem: str) -> None:
    graph = blamed_graphs.graph_of(TWO[0].replace("Keep", other), TWO[1])
    blamed_graphs.Unsteady.given.clear()

    with pytest.raises(BlameError, match=f"of keep {problem}"):
        blamed(two, blamed_graphs.at(40, "scale/out"), graph)


def test_the_state_that_an_operator_was_given_in_the_middle_is_on_the_chain(two: Path, tmp_path: Path) -> None:
    flags = [blamed_graphs.reading(0, "b", k) >= blamed_graphs.HALF for k in range(blamed_graphs.STEPS)]
    k = next(k for k in range(20, blamed_graphs.STEPS) if not any(flags[k - 3 : k + 1]))
    begin, path = (k - 1) * blamed_graphs.STEP * 1e-9, tmp_path / "part.mcap"
    dataflow.replay(two, start=begin, record=path)

    chain = blamed(path, blamed_graphs.at(1, "scale/out"))

    (given,) = [link for link in chain.links if not link.input]
    assert given.call == ("keep", 0)
    assert given.maker is None
    assert [effect.way for effect in given.effects] == ["a new operator"]


def test_where_the_search_among_earlier_calls_ended_is_named(tmp_path: Path) -> None:
    path = ran(tmp_path / "run.mcap", "mean | Mean | x: src/a")

    chain = blamed(path, blamed_graphs.at(40, "mean/out"))

    assert chain.ended == {"mean": 37}
    assert sensed(chain) == {("a", 38), ("a", 39), ("a", 40)}


def test_two_sufficient_inputs_are_named_with_their_readings(tmp_path: Path) -> None:
    a, b, c = ([blamed_graphs.reading(0, s, k) for k in range(blamed_graphs.STEPS)] for s in "abc")
    large = [(x >= blamed_graphs.HALF, y / 2 + z / 2 >= blamed_graphs.HALF) for x, y, z in zip(a, b, c, strict=True)]
    k = next(k for k in range(2, len(large)) if all(large[k]) and not any(large[k - 1]))
    path = ran(tmp_path / "run.mcap", "sum | Add | x: src/b, y: src/c", "either | Either | x: src/a, y: sum/out")

    chain = blamed(path, blamed_graphs.at(k, "either/out"))

    inputs = {link.input: link for link in chain.links if link.call == ("either", k)}
    assert set(inputs) == {"x", "y"}
    assert {effect.together for link in inputs.values() for effect in link.effects} == {2}
    assert {stream for stream, _ in sensed(chain)} in ({"a", "b"}, {"a", "c"}, {"a", "b", "c"})
    assert {number for _, number in sensed(chain)} == {k}


def test_two_sufficient_sensors_are_named_through_operators(tmp_path: Path) -> None:
    a, b = ([3.0 + blamed_graphs.reading(0, s, k) / 2 for k in range(blamed_graphs.STEPS)] for s in "ab")
    large = [(x >= blamed_graphs.LARGE, y >= blamed_graphs.LARGE) for x, y in zip(a, b, strict=True)]
    k = next(k for k in range(2, len(large)) if all(large[k]) and not any(large[k - 1]))
    either = f"either | Either | x: one/out, y: two/out | params: {{at: {blamed_graphs.LARGE}}}"
    path = ran(tmp_path / "run.mcap", "one | Scale | x: src/a", "two | Scale | x: src/b", either)

    chain = blamed(path, blamed_graphs.at(k, "either/out"))

    assert sensed(chain) == {("a", k), ("b", k)}
    assert chain.whole


def test_of_a_batch_the_message_that_decided_is_named(tmp_path: Path) -> None:
    path, k = ran(tmp_path / "run.mcap", "largest | Largest | x: src/a, t: src/slow"), 4 * blamed_graphs.SLOW - 1
    readings = {n: blamed_graphs.reading(0, "a", n) for n in range(k + 1 - blamed_graphs.SLOW, k + 1)}

    chain = blamed(path, blamed_graphs.at(k, "largest/out"))

    assert chain.value == max(readings.values())
    own = [link for link in chain.sensed if any(effect.way == "nudged" for effect in link.effects)]
    assert [link.message for link in own] == [("blamed/src/a", 0, max(readings, key=readings.__getitem__))]


def test_state_forgets_calls_before_its_reassignment(two: Path) -> None:
    flags = [blamed_graphs.reading(0, "b", k) >= blamed_graphs.HALF for k in range(blamed_graphs.STEPS)]
    k = next(k for k in range(20, blamed_graphs.STEPS) if not any(flags[k - 2 : k]))
    last = max(n for n in range(k) if flags[n])

    with Recording(two) as recording:
        line = Line(recording, blamed_graphs.graph_of(*TWO), "keep", lambda: None, lambda nbytes: None)
        line.reach(0, k)
        forgotten = {begin: line.has_forgotten(begin, k) for begin in (last - 1, last, last + 1)}
        line.close()

    assert forgotten == {last - 1: True, last: True, last + 1: False}


@pytest.mark.parametrize("offset", [-HOUR, HOUR])
def test_clocks_of_machines_that_are_off_do_not_hide_a_cause(
    offset: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pick = "pick | Pick | x: scale/out, y: src/c, by: sum/out"
    path = ran(tmp_path / "run.mcap", "sum | Add | x: src/a, y: src/b", "scale | Scale | x: sum/out", pick)
    ordered = FiringLog.ordered

    def shifted(log: FiringLog, node: Node) -> Iterator[FiringRecord]:
        for record in ordered(log, node):
            yield replace(record, wall_start=record.wall_start + offset) if node.name == "scale" else record

    monkeypatch.setattr(FiringLog, "ordered", shifted)
    picked = [
        blamed_graphs.reading(0, "a", k) + blamed_graphs.reading(0, "b", k) > 2 * blamed_graphs.HALF + 5
        for k in range(blamed_graphs.STEPS)
    ]
    k = next(k for k in range(20, blamed_graphs.STEPS) if picked[k])

    chain = blamed(path, blamed_graphs.at(k, "pick/out"))

    nudges = {link.message[0] for link in chain.sensed if link.message for e in link.effects if e.way == "nudged"}
    assert nudges == {"blamed/src/a", "blamed/src/b"}


def test_call_that_raised_in_the_run_hides_nothing_behind_it(tmp_path: Path) -> None:
    live = "live: {restart: {max: 3, backoff: 0s}}"
    graph = blamed_graphs.graph_of(
        "mean | Mean | x: src/a",
        f"fussy | Fussy | x: mean/out | params: {{at: 40}} | {live}",
        "largest | Mean | x: fussy/out",
    )
    path = held_runs.recorded(graph, held_runs.Faults(), tmp_path / "run.mcap")

    with Recording(path) as recording:
        chain = Blame(recording, Field.parse(blamed_graphs.at(42, "largest/out"))).find()

        line = Line(recording, graph, "fussy", lambda: None, lambda nbytes: None)
        line.reach(39, 42)
        line.begin(41)
        made = line.fire(41, line.shots[41].firing)

    assert sensed(chain) == {("a", k) for k in range(36, 42)}
    assert made is not None
    assert isinstance(made["out"], FeatureVector)
    assert blamed_graphs.number(made["out"]) == 0.0, "the first call behind a restart begins anew"


def test_state_set_back_to_initial_leads_to_the_call_that_did(tmp_path: Path) -> None:
    readings = [blamed_graphs.reading(0, "a", k) for k in range(21)]
    assert [k for k, x in enumerate(readings) if x < blamed_graphs.LOW] == [8]
    assert [k for k, x in enumerate(readings) if x > blamed_graphs.HIGH] == [2, 11]
    graph = blamed_graphs.graph_of("latch | Latch | x: src/a")
    path = held_runs.recorded(graph, held_runs.Faults(), tmp_path / "run.mcap")

    chain = blamed(path, blamed_graphs.at(20, "latch/out"))

    assert chain.value == 1.0
    assert sensed(chain) == {("a", 11), ("a", 20)}, "call 20 would have closed it, with another reading"
    assert chain.whole


def test_rows_and_masks_select_values_of_a_field() -> None:
    message = FeatureVector(stamp=5, vectors=np.arange(6, dtype=np.float32).reshape(3, 2), model="m")

    for path in ("[1].vectors[0]", ".vectors[1][0]", ".vectors[vectors[:, 1] == 3.0][0, 0]"):
        assert Field.parse(f"a/b{path}@0").value(message) == 2.0
    assert Field.parse("a/b@1.5") == Field("a/b", "", 1.5)
    assert Field.parse("b@1").value(message) is message
    assert Field.parse("b.vectors[vectors[:, 1] > 9][:, 0].max()@1").value(message) is None


def test_numbers_differ_by_more_than_a_part_of_the_largest_and_others_at_all() -> None:
    before = np.array([1.0, 100.0])

    assert not differ(before, before + 0.009, 1e-4)
    assert differ(before, before + 0.011, 1e-4)
    assert differ(np.array([1, 2]), np.array([1, 3]), 0.5)
    assert differ(before, before[:1], 0.5)
    assert differ(before, None, 0.5)
    assert differ(np.array([np.nan]), np.array([1.0]), 0.5)
    assert not differ({"a": [1]}, {"a": [1]}, 0.0)


def test_integer_scalars_are_not_nudged_with_measurements() -> None:
    boxes = np.array([[1.0, 1.0, 2.0, 2.0]], np.float32)
    scores, classes = np.ones(1, np.float32), np.zeros(1, np.int32)
    found = Detections2D(
        stamp=1,
        frame="camera",
        boxes=boxes,
        scores=scores,
        class_ids=classes,
        class_names=["person"],
        width=6,
        height=4,
    )

    assert [{"width", "height"} & {*names} for names in groups(found, found)] == [set()]
    assert groups(found, found.replace(width=8))[1:] == [("width",)]
    assert "boxes" in groups(found, None)[0]


def test_a_nudge_changes_each_number_a_little_and_keeps_the_type_content() -> None:
    position, orientation = np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    pose = Pose(stamp=1, frame="world", child_frame="body", position=position, orientation=orientation)

    other, names = nudged(pose)

    assert set(names) >= {"position", "orientation"}
    assert other == nudged(pose)[0]
    change = np.abs(other.position - pose.position)
    assert ((change >= 0.0099) & (change <= 0.0201)).all()
    assert nudged(pose, ("position",))[1] == ("position",)
    assert (other.frame, other.stamp) == ("world", 1)
