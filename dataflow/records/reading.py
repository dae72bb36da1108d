"""Firing records of one operator in order: which of them can be repeated, from where, and what they name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from dataflow.records.firing import CALLS, FiringRecord
from dataflow.sync import InputRef, MessageRef

Place = tuple[int, int]
"""(incarnation, number) of a message in its stream."""
Digests = Mapping[str, Mapping[Place, bytes]]
"""Stream → place → the recorded digest."""


def first_places(ref: InputRef) -> Iterator[tuple[str, tuple[int, int]]]:
    """(stream, (incarnation, number)) of the first message that a reference names on each stream."""
    match ref:
        case None:
            return
        case MessageRef():
            yield ref.stream, (ref.incarnation, ref.seq)
        case tuple():
            for run in ref:
                yield run.stream, (run.incarnation, run.first_seq)
        case _:
            for one in ref.values():
                yield one.stream, (one.incarnation, one.seq)


def needed_from(records: Iterable[FiringRecord]) -> dict[str, tuple[int, int]]:
    """By stream, the first message (incarnation, number) that the calls of `records` took."""
    needed: dict[str, tuple[int, int]] = {}
    for record in records:
        for ref in record.inputs.values():
            for stream, place in first_places(ref):
                needed[stream] = min(place, needed.get(stream, place))
    return needed


def whole(records: Iterable[FiringRecord]) -> tuple[list[FiringRecord], int]:
    """The records by (incarnation, index), each once, and how many calls had to be left out.

    Where records are missing, those after them in the same incarnation cannot be repeated: the operator's state there
    is not known. The next incarnation begins from `setup()` again (or, after a jump of the clock, does not).
    """
    kept: list[FiringRecord] = []
    lost = 0
    following = (0, 0)
    known = True
    for record in sorted(records, key=lambda r: (r.incarnation, r.index)):
        place = (record.incarnation, record.index)
        if place < following:
            continue  # handed over twice, when its process died
        begins = record.incarnation > following[0] or not following[1]
        if begins:
            known = record.index == 0 and (record.kind != "reset" or known)
        else:
            known = known and place == following
        following = (record.incarnation, record.index + 1)
        if known:
            kept.append(record)
        else:
            lost += record.kind in CALLS
    return kept, lost


def beginning(
    records: list[FiringRecord], begin: int | None, *, stateless: bool
) -> tuple[list[FiringRecord], list[FiringRecord], str]:
    """What lies before the place from which records are repeated, the rest, and how that place was found.

    It is after the last snapshot at or before the stamp `begin`, or at `begin` itself for an operator without state;
    for any other at the start, since its state in the middle is not known.
    """
    if begin is None:
        return [], records, "start"
    place = max((k + 1 for k, r in enumerate(records) if r.kind == "snapshot" and r.stamp <= begin), default=0)
    if stateless:
        place = next((k for k, r in enumerate(records) if r.kind in CALLS and r.stamp >= begin), len(records))
    found = "stateless" if stateless else "snapshot" if place else "start"
    return records[:place], records[place:], found
