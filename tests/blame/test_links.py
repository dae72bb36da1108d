"""The order of links, the calls from which none leads on, and what could not be tried."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.blame.field import change, differ
from dataflow.blame.line import Call
from dataflow.blame.links import Chain, Effect, Link, UntestedInput, Way
from dataflow.blame.nudge import SIZE, nudged
from dataflow.messages import FeatureVector, Image

TARGET = Call("plan", 9)


def link(call: Call, maker: Call | None, *effects: Effect, name: str = "x") -> Link:
    message = (f"rig/{'src' if maker is None else maker.operator}/out", 0, 0)
    return Link(call, 0, name, message if name else None, 0, maker, effects)


def chain(value: object, *links: Link) -> Chain:
    return Chain(TARGET, ("rig/plan/out", 0, 9), 0, value, links=list(links))


@pytest.mark.parametrize(
    ("before", "after", "by"),
    [
        (np.array([1.0, 5.0]), np.array([1.5, 3.0]), 2.0),
        (True, False, 1.0),
        (3, 5, 2.0),
        (1.0, 1.0 + 2.0j, 2.0),
        (np.array([1.0]), np.array([1.0, 2.0]), np.inf),
        (np.array([]), np.array([]), np.inf),
        ("near", "far", np.inf),
        (1.0, "far", np.inf),
        ("near", 1.0, np.inf),
        (np.array([1.0, np.nan]), np.array([9.0, 2.0]), np.inf),
    ],
)
def test_change_is_the_largest_numeric_difference_else_infinite(before: object, after: object, by: float) -> None:
    assert change(before, after) == by


def test_values_of_several_kinds_differ_by_their_content() -> None:
    assert differ({"a": [1]}, {"a": [2]}, 0.5)
    assert not differ({"a": [1]}, {"a": [1]}, 0.5)
    assert differ(["one", 1, None], ["one", 2, None], 0.5)
    assert differ("near", "far", 0.5)
    assert differ(1, 1.0, 0.5)


def test_link_weight_combines_nudges_and_replaced_content() -> None:
    def weighed(value: object, *effects: tuple[Way, object]) -> tuple[float, float]:
        return chain(value).weight(link(TARGET, None, *(Effect(way, (), after) for way, after in effects)))

    assert weighed(5.0, ("nudged", 5.02)) == (0.02 / SIZE, 0.0)
    assert weighed(5.0, ("nudged", 5.02), ("left out", 1.0), ("another", 70.0)) == (4.0, 65.0)
    assert weighed(5, ("nudged", 6)) == (1.0, 0.0)  # a class: one more is no slope
    assert weighed(5.0, ("the one before", 5.5), ("another", 5.25)) == (0.0, 0.5)


def test_calls_are_linked_by_inputs_or_by_state() -> None:
    nudge = Effect("nudged", (), 1.0)
    track, early = Call("track", 5), Call("track", 2)
    found = chain(0.0, link(TARGET, track, nudge), link(Call("track", 7), early, nudge, name=""))

    assert found.loose_of([TARGET]) == []
    assert found.loose_of([track, Call("track", 7), Call("track", 3)]) == []
    assert found.loose_of([early, Call("track", 8), Call("map", 5)]) == [early, Call("track", 8), Call("map", 5)]


def test_calls_that_count_only_by_other_content_need_no_further_link() -> None:
    nudge, other = Effect("nudged", (), 1.0), Effect("the one before", (), 1.0)
    aside, behind, own = Call("clock", 1), Call("drift", 1), Call("track", 5)
    beside = [link(TARGET, own, nudge), link(TARGET, aside, other), link(aside, behind, nudge)]

    assert chain(0.0, *beside).loose_of([aside, behind, own]) == [own]
    assert chain(0.0, *beside[1:]).loose_of([aside, behind]) == [behind]  # nothing else leads on from the target
    assert chain(0.0, *beside, link(own, behind, nudge)).loose_of([behind]) == [behind]


def test_calls_beside_each_other_that_could_not_be_tried_are_noted_together() -> None:
    found = chain(0.0)
    found.was_raised(Call("map", 5), 6, "", "first")
    found.was_raised(Call("map", 4), 4, "", "second")
    found.was_raised(Call("map", 1), 2, "", "third")
    found.was_raised(Call("map", 4), 4, "x", "an input")
    found.was_raised(Call("track", 3), 3, "", "another operator")

    assert found.untried == [
        UntestedInput(Call("map", 4), 6, "", "second"),
        UntestedInput(Call("map", 1), 2, "", "third"),
        UntestedInput(Call("map", 4), 4, "x", "an input"),
        UntestedInput(Call("track", 3), 3, "", "another operator"),
    ]


def test_whole_numbers_move_by_one_at_least_and_not_beyond_their_type() -> None:
    data = np.array([[0, 255], [100, 7]], np.uint8)
    image = Image(stamp=1, frame="camera", data=data)

    moved = {sign: nudged(image, ("data",), sign=sign)[0].data.astype(int) - data for sign in (1, -1)}

    for change_ in moved.values():
        assert ((abs(change_) >= 2) & (abs(change_) <= 3)).all()
        assert change_[0, 0] > 0 > change_[0, 1]
    assert (moved[1][1] == -moved[-1][1]).all()


def test_large_numbers_move_by_a_part_of_the_largest() -> None:
    vectors = np.array([[1000.0, 0.0]])
    message = FeatureVector(stamp=1, vectors=vectors, model="m")

    change_ = abs(nudged(message)[0].vectors - vectors)

    assert ((change_ >= 5.0) & (change_ <= 10.0)).all()
