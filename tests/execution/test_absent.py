"""Firings of a live run whose producers are gone."""

from __future__ import annotations

import pytest
from firing_operators import Looks, entry, node

from dataflow.execution.live import without_absent
from dataflow.graph.model import Live
from dataflow.sync import Firing

INPUTS = {"x": ["t/s/x"], "constant": ["t/m/c"], "image": ["t/s/image"]}
FIRING = Firing(
    100,
    "fire",
    inputs={"x": entry("t/s/x", 100, 0), "constant": entry("t/m/c", 0, 0), "image": entry("t/s/image", 90, 3)},
)


def test_a_firing_of_present_producers_is_left_alone() -> None:
    assert without_absent(FIRING, node(Looks, INPUTS), {"t/elsewhere/y"}) is FIRING


@pytest.mark.parametrize("policy", ["keep", "drop"])
def test_samples_of_absent_producer_are_stale_and_dropped_by_policy(policy: str) -> None:
    made = node(Looks, INPUTS, Live("newest", 16, {}, on_stale=policy))

    changed = without_absent(FIRING, made, {"t/s/image"})

    assert changed.stale == {"image"}
    assert (changed.inputs["image"] is None) == (policy == "drop")
    assert changed.inputs["x"] is FIRING.inputs["x"]


def test_a_required_input_stays_and_triggers_are_not_marked() -> None:
    made = node(Looks, INPUTS, Live("newest", 16, {}, on_stale="drop"))

    changed = without_absent(FIRING, made, {"t/m/c", "t/s/x"})

    assert changed.stale == {"constant"}
    assert changed.inputs == FIRING.inputs
