"""What a new process is told about the one whose place it takes."""

from __future__ import annotations

import pytest

from dataflow.records.firing import WITHHELD, Emission, FiringRecord, encode_batch
from dataflow.supervision.held_records import HeldRecords


def param(index: int, name: str, value: object, incarnation: int = 0) -> bytes:
    return encode_batch([FiringRecord("gain", incarnation, index, "param", 0, detail={"name": name, "value": value})])


def fire(index: int, *stamps: int | None, incarnation: int = 0, seq: int = 0) -> bytes:
    """A firing that emitted at these stamps, one for each port."""
    outputs = tuple(None if s is None else Emission(seq, s, bytes(16)) for s in stamps)
    return encode_batch([FiringRecord("gain", incarnation, index, "fire", 1, outputs=outputs)])


BATCHES = [
    param(0, "gain", 3.0),
    param(1, "bias", 1.0),
    fire(2, 10, 20),  # the only message of the second port
    fire(3, 30, None),
    param(4, "gain", 5.0),
    fire(5, 40, None),
    fire(6, 35, None, seq=WITHHELD),
    fire(0, 50, None, incarnation=2),
]


@pytest.mark.parametrize("size", [1, 2, 3, 8, 100])
def test_nothing_that_a_new_process_needs_depends_on_how_many_records_are_held(size: int) -> None:
    held = HeldRecords(("y", "rare"), size)
    for batch in BATCHES:
        held.add(batch)

    assert held.resumed() == {"incarnation": 3, "last": {"y": 50, "rare": 20}, "changed": {"gain": 5.0, "bias": 1.0}}
    assert list(held.batches) == BATCHES[-size:]
    assert held.resumed() == held.resumed()


def test_a_clock_that_jumped_back_leaves_no_stamps() -> None:
    held = HeldRecords(("y",), 1)
    for batch in (fire(0, 90), encode_batch([FiringRecord("gain", 1, 0, "reset", 0)]), fire(1, 15, incarnation=1)):
        held.add(batch)

    assert held.resumed() == {"incarnation": 2, "last": {"y": 15}, "changed": {}}


def test_an_operator_that_said_nothing_yet_begins_its_first_new_incarnation() -> None:
    assert HeldRecords(("y",)).resumed() == {"incarnation": 1, "last": {}, "changed": {}}


def test_what_is_held_is_bounded_in_bytes_and_the_last_snapshot_is_always_there() -> None:
    held = HeldRecords(("y",), nbytes=10_000)
    for k in range(100):
        detail = {"state": bytes(4_000)}
        held.add(encode_batch([FiringRecord("map", 0, 2 * k, "snapshot", k, detail=detail)]))
        held.add(fire(2 * k + 1, k))
        assert held.held == sum(map(len, held.batches)) <= 10_000

    held.add(encode_batch([FiringRecord("map", 0, 200, "snapshot", 100, detail={"state": bytes(50_000)})]))
    assert len(held.batches) == 1
    assert held.resumed()["last"] == {"y": 99}
