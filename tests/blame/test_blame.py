"""The chain that is found is the one that is known: what must have decided a value, and nothing that cannot have."""

from __future__ import annotations

from pathlib import Path

import blamed_graphs
import numpy as np
import pytest

from dataflow.blame.chain import Blame, BlameError, Chain
from dataflow.blame.field import Field, differ
from dataflow.blame.nudge import nudged
from dataflow.graph import load_text
from dataflow.messages import FeatureVector, Pose
from dataflow.recording import Recording

KEEPS = 85
"""The seed of a graph without selections before a state, of which the value is two calls old."""


def found(case: blamed_graphs.Case, path: Path, budget: float = 600.0) -> Chain:
    with Recording(path) as recording:
        return Blame(recording, Field.parse(case.field), budget=budget).find()


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


def test_what_the_time_does_not_suffice_for_is_named(kept: tuple[blamed_graphs.Case, Path]) -> None:
    chain = found(*kept, budget=1e-9)

    assert not chain.whole
    assert chain.left == [chain.target]


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
def test_a_value_that_cannot_be_asked_for_is_refused(
    kept: tuple[blamed_graphs.Case, Path], field: str, problem: str
) -> None:
    with Recording(kept[1]) as recording, pytest.raises((BlameError, ValueError)) as caught:
        Blame(recording, Field.parse(field)).find()

    assert problem in str(caught.value)


def test_code_that_gives_something_else_now_is_not_blamed(kept: tuple[blamed_graphs.Case, Path]) -> None:
    case, path = kept
    other = load_text(case.text.replace("blamed_graphs:Keep", "blamed_graphs:KeepHalf"))

    with Recording(path) as recording, pytest.raises(BlameError, match="does not give what was recorded"):
        Blame(recording, Field.parse(case.field), other).find()


def test_a_row_stands_before_or_behind_its_field_and_brackets_see_other_fields() -> None:
    message = FeatureVector(stamp=5, vectors=np.arange(6, dtype=np.float32).reshape(3, 2), model="m")

    for path in ("[1].vectors[0]", ".vectors[1][0]", ".vectors[vectors[:, 1] == 3.0][0, 0]"):
        assert Field.parse(f"a/b{path}@0").value(message) == 2.0
    assert Field.parse("a/b@1.5") == Field("a/b", "", 1.5)
    assert Field.parse("b@1").value(message) is message


def test_numbers_differ_by_more_than_a_part_of_the_largest_and_others_at_all() -> None:
    before = np.array([1.0, 100.0])

    assert not differ(before, before + 0.009, 1e-4)
    assert differ(before, before + 0.011, 1e-4)
    assert differ(np.array([1, 2]), np.array([1, 3]), 0.5)
    assert differ(before, before[:1], 0.5)
    assert differ(before, None, 0.5)
    assert differ(np.array([np.nan]), np.array([1.0]), 0.5)
    assert not differ({"a": [1]}, {"a": [1]}, 0.0)


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
