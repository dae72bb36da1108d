"""Firing records hold everything that is needed to drive an operator again."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.records.firing import Emission, FiringRecord, FiringRecordError, decode_batch, encode_batch
from dataflow.sync import (
    Aligner,
    AlignSpec,
    BatchSpec,
    Drop,
    Entry,
    Firing,
    MessageRef,
    RecordedAligner,
    RunRef,
    SampledSpec,
    TriggerSpec,
    Uses,
    refs_of,
)

names = st.text("abc/é", min_size=1, max_size=8)
stamps = st.integers(-(2**63) + 1, 2**62)
numbers = st.integers(0, 2**40)
message_refs = st.builds(MessageRef, names, st.integers(0, 9), numbers)
run_refs = st.builds(lambda s, i, a, n: RunRef(s, i, a, a + n), names, st.integers(0, 9), numbers, st.integers(0, 99))
input_refs = st.one_of(
    st.none(),
    message_refs,
    st.lists(run_refs, max_size=3).map(tuple),
    st.dictionaries(names, st.tuples(st.integers(0, 9), numbers), max_size=3).map(
        lambda d: {s: MessageRef(s, i, n) for s, (i, n) in d.items()}
    ),
)
emissions = st.one_of(
    st.none(), st.builds(Emission, numbers, st.integers(0, 2**60), st.binary(min_size=16, max_size=16))
)
drops = st.builds(
    Drop, names, names, st.integers(0, 2**60), numbers, st.integers(0, 9), st.sampled_from(["late", "unused"]), names
)


@st.composite
def batches(draw: st.DrawFn) -> list[FiringRecord]:
    inputs = draw(st.lists(names, unique=True, max_size=3))
    first = draw(st.integers(0, 1000))
    return [
        FiringRecord(
            operator="front/cloud",
            incarnation=2,
            index=first + k,
            kind=draw(st.sampled_from(["setup", "fire", "tick", "finish", "param", "reset", "restore"])),
            stamp=draw(st.integers(0, 2**60)),
            tick=draw(st.booleans()),
            inputs={name: draw(input_refs) for name in inputs},
            stale=draw(st.frozensets(names, max_size=2)),
            late=draw(st.frozensets(names, max_size=2)),
            outputs=tuple(draw(st.lists(emissions, max_size=3))),
            outcome=draw(st.sampled_from(["ok", "error"])),
            drops=tuple(draw(st.lists(drops, max_size=2))),
            detail=draw(st.dictionaries(names, st.one_of(st.integers(0, 9), names), max_size=2)),
            wall_start=draw(numbers),
            duration=draw(numbers),
        )
        for k in range(draw(st.integers(1, 4)))
    ]


@given(batches(), st.booleans())
@settings(max_examples=60, deadline=None)
def test_firing_batch_survives_encoding(records: list[FiringRecord], last: bool) -> None:
    batch = decode_batch(encode_batch(records, last=last))

    assert list(batch.records) == records
    assert (batch.operator, batch.incarnation, batch.last) == ("front/cloud", 2, last)


@given(st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_bytes_that_are_no_batch_are_refused_with_a_clear_error(data: bytes) -> None:
    with pytest.raises(FiringRecordError):
        decode_batch(data)


@given(batches(), st.integers(0, 10**6), st.integers(0, 255))
@settings(max_examples=60, deadline=None)
def test_a_damaged_batch_is_refused_or_read_never_anything_else(
    records: list[FiringRecord], where: int, byte: int
) -> None:
    data = bytearray(encode_batch(records))
    data[where % len(data)] = byte
    try:
        decode_batch(bytes(data))
    except FiringRecordError:
        return


def test_a_record_is_about_eighty_bytes() -> None:
    records = [
        FiringRecord(
            "odometry",
            0,
            k,
            "fire",
            1_600_000_000_000_000_000 + k * 33_333_333,
            inputs={name: MessageRef(f"robot1/camera/{name}", 0, k) for name in ("image", "depth")},
            outputs=(Emission(k, 1_600_000_000_000_000_000 + k * 33_333_333, bytes(16)),),
            wall_start=1_600_000_000_000_000_000,
            duration=20_000_000,
        )
        for k in range(64)
    ]

    assert len(encode_batch(records)) / 64 < 90


SPEC = AlignSpec(
    triggers=(TriggerSpec("a", ("a",)), TriggerSpec("b", ("b",))),
    sampled=(SampledSpec("s", ("s",), max_age=25, required=False), SampledSpec("f", ("s",), before=1, required=False)),
    batches=(BatchSpec("m", ("m",), max=4),),
    tolerance=3,
    every=20,
)


def live_firings(seed: int) -> tuple[list[Firing], dict[str, list[Entry]]]:
    """Firings of an aligner whose frontiers are forced at random moments, as a live process does, and all messages."""
    dice = random.Random(seed)
    streams = {
        name: [
            Entry(t, (name, t), seq, 0, b"", name) for seq, t in enumerate(sorted(dice.sample(range(1, 200), count)))
        ]
        for name, count in (("a", 20), ("b", 20), ("s", 12), ("m", 40))
    }
    aligner = Aligner(SPEC)
    waiting = {name: list(entries) for name, entries in streams.items()}
    firings: list[Firing] = []
    reached = 0
    while any(waiting.values()):
        name = dice.choice([n for n, entries in waiting.items() if entries])
        entry = waiting[name].pop(0)
        aligner.push(name, entry)
        reached = max(reached, entry.stamp)
        if dice.random() < 0.3:
            aligner.force(dice.choice(["a", "b", "s", "f", "m"]), reached - dice.randrange(0, 30))
        while (firing := aligner.poll()) is not None:
            firings.append(firing)
    for name, entries in streams.items():
        aligner.end(name, max(entries[-1].stamp, 0), "over")
    while (firing := aligner.poll()) is not None:
        firings.append(firing)
    return firings, streams


@given(st.integers(0, 10**9), st.integers(0, 10**9))
@settings(max_examples=120, deadline=None)
def test_a_live_run_with_forced_frontiers_is_driven_again_by_its_written_records(seed: int, order: int) -> None:
    firings, streams = live_firings(seed)
    records = [
        FiringRecord("op", 0, k, r.kind, r.stamp, tick=r.tick, inputs=r.inputs, stale=r.stale, late=r.late)
        for k, r in enumerate(map(refs_of, firings))
    ]
    written = [encode_batch(records[k : k + 7]) for k in range(0, len(records), 7)]
    read = [record.firing() for data in written for record in decode_batch(data).records]

    uses = Uses()
    for record in read:
        uses.add(record.inputs)
    driven, left = RecordedAligner(SPEC, uses), list(read)
    dice = random.Random(order)
    waiting = {name: list(entries) for name, entries in streams.items()}
    again: list[Firing] = []
    while True:
        while left and (firing := driven.take(left[0])) is not None:
            again.append(firing)
            del left[0]
        open_ = [n for n, entries in waiting.items() if entries]
        if not open_:
            break
        name = dice.choice(open_)
        driven.push(name, waiting[name].pop(0))

    assert again == firings
    assert not left
    assert not any(driven.buffered().values())
    values = [[e.value for e in _entries(f)] for f in firings]
    assert [[e.value for e in _entries(f)] for f in again] == values


def _entries(firing: Firing) -> list[Entry]:
    found: list[Entry] = []
    for given_ in firing.inputs.values():
        found += [given_] if isinstance(given_, Entry) else list(given_ or ())
    return found


def test_forced_frontiers_change_firings_so_the_property_is_not_vacuous() -> None:
    outcomes = set()
    for seed in range(20):
        firings, _ = live_firings(seed)
        outcomes.add(any(f.late for f in firings))
    assert outcomes == {True, False}
