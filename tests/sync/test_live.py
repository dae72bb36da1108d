"""Forced frontiers and restarts: what is late, and that the recorded firings can be had again."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import (
    FOREVER,
    Aligner,
    AlignSpec,
    BatchSpec,
    Entry,
    Firing,
    RunRef,
    SampledSpec,
    TriggerSpec,
    refs_of,
)

from .scenarios import HORIZON, Repeater, Scenario, Step, entries, interleave, poll_all, push, run, scenarios, tell

A = TriggerSpec("a", ("a",))
B = TriggerSpec("b", ("b",))
seeds = st.integers(0, 2**32 - 1)


def stamps(firings: list[Firing]) -> list[int]:
    return [f.stamp for f in firings]


def test_trigger_is_late_up_to_the_last_decided_stamp() -> None:
    aligner = Aligner(AlignSpec((A, B), mode="merge"))
    push(aligner, "b", 60)
    aligner.force("a", 100)
    assert stamps(poll_all(aligner)) == [60]
    push(aligner, "a", 55, 60, 70)
    aligner.advance("b", 70)
    assert stamps(poll_all(aligner)) == [70]
    assert aligner.drops == {("a", "late"): 2}


def test_a_join_that_was_forced_to_pass_over_an_anchor_has_decided_it() -> None:
    aligner = Aligner(AlignSpec((A, B)))
    push(aligner, "a", 50)
    aligner.force("b", 100)
    assert aligner.poll() is None
    push(aligner, "b", 50, 60)
    assert aligner.drops == {("a", "unmatched"): 1, ("b", "late"): 1}


def test_messages_up_to_the_promised_output_frontier_are_late() -> None:
    aligner = Aligner(AlignSpec((A,)))
    aligner.force("a", 100)
    assert aligner.output_frontier() == 100
    push(aligner, "a", 100, 101)
    assert stamps(poll_all(aligner)) == [101]
    assert aligner.drops == {("a", "late"): 1}


def test_a_matched_message_is_not_given_to_an_anchor_that_comes_late() -> None:
    aligner = Aligner(AlignSpec((A, B), tolerance=10))
    push(aligner, "a", 0)
    push(aligner, "b", 4, 5)
    aligner.force("a", 10)
    assert stamps(poll_all(aligner)) == [0]
    aligner.push("a", Entry(2, seq=1))  # not late: above the last decided stamp, but its nearest, 4, is taken
    aligner.push("a", Entry(30, seq=2))
    assert poll_all(aligner) == []
    assert aligner.drops["a", "unmatched"] == 1


def test_a_late_sample_serves_the_next_firing_and_is_flagged() -> None:
    aligner = Aligner(AlignSpec((A,), (SampledSpec("x", ("x",), required=False),)))
    push(aligner, "a", 10)
    aligner.force("x", 10)
    assert poll_all(aligner)[0].inputs["x"] is None
    push(aligner, "x", 9)
    push(aligner, "a", 20)
    aligner.force("x", 20)
    (firing,) = poll_all(aligner)
    assert isinstance(firing.inputs["x"], Entry)
    assert (firing.inputs["x"].stamp, firing.late) == (9, {"x"})
    assert not aligner.drops


def test_a_late_batch_message_goes_into_the_next_batch_and_is_flagged() -> None:
    aligner = Aligner(AlignSpec((A,), batches=(BatchSpec("imu", ("imu",)),)))
    imu = entries("imu", 5, 8, 12)
    push(aligner, "a", 10)
    aligner.push("imu", imu[0])
    aligner.force("imu", 10)
    (first,) = poll_all(aligner)
    aligner.push("imu", imu[1])
    aligner.push("imu", imu[2])
    aligner.push("a", Entry(12, seq=1))
    (second,) = poll_all(aligner)
    assert refs_of(first).inputs["imu"] == (RunRef("imu", 0, 0, 0),)
    assert refs_of(second).inputs["imu"] == (RunRef("imu", 0, 1, 2),)
    assert (first.late, second.late) == (frozenset(), {"imu"})


def test_ticks_go_on_by_force_when_the_inputs_have_stopped() -> None:
    aligner = Aligner(AlignSpec((A,), every=10))
    push(aligner, "a", 5)
    assert stamps(poll_all(aligner)) == [5]
    assert aligner.waiting().stamp == 10
    aligner.force("a", 30)
    assert stamps(poll_all(aligner)) == [10, 20, 30]
    push(aligner, "a", 25, 31)
    assert stamps(poll_all(aligner)) == [31]
    assert aligner.drops == {("a", "late"): 1}


def test_messages_repeated_by_a_restarted_stream_are_late_and_new_ones_fire() -> None:
    aligner = Aligner(AlignSpec((A,), (SampledSpec("x", ("a",)),)))
    push(aligner, "a", 5, 10)
    aligner.reset("a", 1)
    aligner.push("a", Entry(8, seq=0, incarnation=1))
    aligner.push("a", Entry(12, seq=1, incarnation=1))
    fired = poll_all(aligner)
    assert stamps(fired) == [5, 10, 12]
    assert aligner.drops == {("a", "late"): 1, ("x", "late"): 1}
    ref = refs_of(fired[-1]).inputs["a"]
    assert (ref.stream, ref.incarnation, ref.seq) == ("a", 1, 1)


def test_a_stream_that_ended_opens_again_when_its_source_restarts() -> None:
    aligner = Aligner(AlignSpec((A, B), mode="merge"))
    push(aligner, "a", 5)
    aligner.end("a", 5, "process died")
    push(aligner, "b", 9)
    assert stamps(poll_all(aligner)) == [5, 9]
    aligner.push("a", Entry(7, seq=0, incarnation=1))
    aligner.push("b", Entry(11, seq=1))
    assert stamps(poll_all(aligner)) == []  # it is waited for again
    aligner.push("a", Entry(12, seq=1, incarnation=1))
    aligner.push("b", Entry(12, seq=2))
    assert stamps(poll_all(aligner)) == [11, 12]
    assert aligner.drops == {("a", "late"): 1}
    assert "a" not in aligner.ends


def with_restarts(says: dict[str, list[Step]], spec: AlignSpec, rng: random.Random) -> dict[str, list[Step]]:
    """Some streams die and come back with a new incarnation, whose stamps may overlap the old ones."""
    changed = {}
    for stream, steps in says.items():
        if stream in spec.static or rng.random() < 0.7:
            changed[stream] = steps
            continue
        again = sorted(rng.sample(range(HORIZON), 5))
        second: list[Step] = [
            ("push", stream, Entry(stamp, f"{stream}'@{stamp}", seq, 1, stream=stream))
            for seq, stamp in enumerate(again)
        ]
        first = steps if rng.random() < 0.5 else steps[:-1]
        changed[stream] = [*first, *second, ("end", stream, None)]
    return changed


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(scenarios(), seeds)
def test_firings_of_a_live_run_can_be_had_again_from_their_refs(scenario: Scenario, seed: int) -> None:
    rng = random.Random(seed)
    says = with_restarts(dict(scenario.says), scenario.spec, rng)
    aligner = Aligner(scenario.spec)
    inputs = [spec.name for spec in scenario.spec.inputs]
    fired: list[Firing] = []
    promised = aligner.output_frontier()
    for step in interleave(says, rng):
        tell(aligner, step)
        if rng.random() < 0.3:
            aligner.force(rng.choice(inputs), rng.randint(0, HORIZON + 10))
        if rng.random() < 0.5:
            assert aligner.output_frontier() >= promised
            promised = aligner.output_frontier()
        while rng.random() < 0.8 and (firing := aligner.poll()) is not None:
            assert firing.stamp > promised
            assert not fired or firing.stamp > fired[-1].stamp
            fired.append(firing)
    fired += poll_all(aligner)
    assert [f.kind for f in fired].count("finish") == 1
    assert fired[-1].kind == "finish"

    records = [refs_of(firing) for firing in fired]
    messages = {s: [m for m in steps if m[0] == "push"] for s, steps in says.items()}
    recorded = Repeater(scenario.spec, iter(records))
    again = poll_all(recorded)
    for _, stream, entry in interleave(messages, random.Random(seed + 1)):
        assert isinstance(entry, Entry)
        recorded.push(stream, entry)
        again += poll_all(recorded)
    assert repr(again) == repr(fired)
    assert again == fired
    assert recorded.ended()
    assert not any(recorded.buffered().values())


@settings(max_examples=100, deadline=None)
@given(scenarios(), seeds)
def test_forcing_the_awaited_inputs_decides_the_stamp(scenario: Scenario, seed: int) -> None:
    rng = random.Random(seed)
    aligner = Aligner(scenario.spec)
    for step in interleave(scenario.says, rng):
        tell(aligner, step)
        poll_all(aligner)
        waiting = aligner.waiting()
        if waiting is None or rng.random() < 0.5:
            continue
        assert waiting.needs, "a stamp that waits for nothing is decided"
        static_missing = {
            i.name
            for i in scenario.spec.inputs
            if any(s in scenario.spec.static - set(aligner.ends) for s in i.streams)
        }
        unforced = {name for name, frontier in waiting.needs.items() if frontier == FOREVER}
        assert unforced <= static_missing
        for name in waiting.needs.keys() - unforced:
            assert aligner.force(name, waiting.needs[name]), "forcing what is needed is news"
            assert not aligner.force(name, waiting.needs[name]), "once"
        poll_all(aligner)
        after = aligner.waiting()
        assert after is None or after.stamp > waiting.stamp or (unforced and set(after.needs) <= static_missing)


def test_recorded_aligner_buffers_only_messages_of_later_records() -> None:
    spec = AlignSpec((A,), (SampledSpec("x", ("x",), required=False, max_age=1),))
    says: dict[str, list[Step]] = {
        "a": [("push", "a", e) for e in entries("a", *range(0, 900, 10))],
        "x": [("push", "x", e) for e in entries("x", *range(5, 900, 10))],
    }
    fired = run(spec, interleave(says, random.Random(0)))
    recorded = Repeater(spec, [refs_of(f) for f in fired])

    for step in says["x"]:
        tell(recorded, step)
    assert recorded.buffered() == {"a": 0, "x": 0}
    for step in says["a"][: len(fired)]:
        tell(recorded, step)
    assert recorded.buffered() == {"a": len(fired), "x": 0}
    assert len(poll_all(recorded)) == len(fired)
    assert recorded.buffered() == {"a": 0, "x": 0}


def test_recorded_aligner_names_the_message_it_waits_for() -> None:
    spec = AlignSpec((A,))
    says: dict[str, list[Step]] = {"a": [("push", "a", e) for e in entries("a", 1, 2)]}
    records = [refs_of(f) for f in run(spec, interleave(says, random.Random(0)))]
    recorded = Repeater(spec, records)
    recorded.push("a", entries("a", 1, 2)[1])
    assert recorded.poll() is None
    missing = recorded.missing()
    assert missing is not None
    assert (missing.stream, missing.seq) == ("a", 0)
