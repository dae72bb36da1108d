"""The aligner's law and its agreement with the rules, over random operators, streams and interleavings."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import FOREVER, Aligner, context, lanes

from . import reference
from .scenarios import Scenario, interleave, poll_all, run, scenarios, tell

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module", autouse=True)
def prune_at_once() -> Iterator[None]:
    """Streams here are short: lanes are pruned from the first message on, or never would be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes, "PRUNE_AT", 0)
        patch.setattr(context, "PRUNE_AT", 0)
        yield


@settings(max_examples=250, deadline=None)
@given(scenarios(), seeds)
def test_firings_and_drops_follow_the_rules_for_every_interleaving(scenario: Scenario, seed: int) -> None:
    expected, expected_drops = reference.firings(scenario.spec, scenario.streams, scenario.finals)
    rng = random.Random(seed)
    tested = Aligner(scenario.spec)
    fired = []
    promised = tested.output_frontier()
    for step in interleave(scenario.says, rng):
        tell(tested, step)
        if rng.random() < 0.5:
            now = tested.output_frontier()
            assert now >= promised, "an output frontier never goes back"
            promised = now
        while rng.random() < 0.8 and (firing := tested.poll()) is not None:
            assert firing.stamp > promised, "a firing lies above every output frontier given out before"
            fired.append(firing)
    fired += poll_all(tested)

    assert fired == expected
    assert tested.drops == expected_drops
    assert len(tested.take_drops()) == sum(expected_drops.values())
    assert tested.ended()
    assert tested.output_frontier() == FOREVER


@settings(max_examples=50, deadline=None)
@given(scenarios(), seeds, seeds)
def test_values_given_to_firings_are_independent_of_arrival_order(scenario: Scenario, one: int, two: int) -> None:
    first = run(scenario.spec, interleave(scenario.says, random.Random(one)))
    second = run(scenario.spec, interleave(scenario.says, random.Random(two)))
    assert repr(first) == repr(second)
