"""The aligner's law and its agreement with the rules, over random operators, streams and interleavings."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import FOREVER, Aligner

from . import reference
from .scenarios import Scenario, interleave, poll_all, run, scenarios, tell

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=400, deadline=None)
@given(scenarios(), seeds)
def test_firings_and_drops_follow_the_rules_for_every_interleaving(scenario: Scenario, seed: int) -> None:
    expected, expected_drops = reference.firings(scenario.spec, scenario.streams, scenario.finals)
    rng = random.Random(seed)
    aligner = Aligner(scenario.spec)
    fired = []
    promised = aligner.output_frontier()
    for step in interleave(scenario.says, rng):
        tell(aligner, step)
        if rng.random() < 0.5:
            now = aligner.output_frontier()
            assert now >= promised, "an output frontier never goes back"
            promised = now
        while rng.random() < 0.8 and (firing := aligner.poll()) is not None:
            assert firing.stamp > promised, "a firing lies above every output frontier given out before"
            fired.append(firing)
    fired += poll_all(aligner)

    assert fired == expected
    assert aligner.drops == expected_drops
    assert len(aligner.take_drops()) == sum(expected_drops.values())
    assert aligner.ended()
    assert aligner.output_frontier() == FOREVER


@settings(max_examples=100, deadline=None)
@given(scenarios(), seeds, seeds)
def test_values_given_to_firings_are_independent_of_arrival_order(
    scenario: Scenario, one: int, two: int
) -> None:
    first = run(scenario.spec, interleave(scenario.says, random.Random(one)))
    second = run(scenario.spec, interleave(scenario.says, random.Random(two)))
    assert repr(first) == repr(second)
