"""Firing records of several parts of one run, joined into one log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from dataflow.records.cuts import Held, cut_record, held_by, taken_by
from dataflow.records.firing import WITHHELD, FiringRecord


def joined(parts: Sequence[Iterable[FiringRecord]], streams: Sequence[str]) -> list[FiringRecord]:
    """The records of one operator that any of `parts` holds, in order. `streams`: those of its ports.

    A `cut` stays where the records that it stands in for are in none of them.
    """
    records: dict[tuple[int, int], FiringRecord] = {}
    cuts: dict[tuple[int, int], FiringRecord] = {}
    held: dict[tuple[str, int, int], Held] = {}
    for part in parts:
        for record in part:
            place = record.incarnation, record.index
            if record.kind != "cut":
                records.setdefault(place, record)
                continue
            held |= {(h.stream, *h.place): h for h in held_by(record)}
            if place not in cuts or "state" in record.detail:
                cuts[place] = record
    for place, cut in cuts.items():
        if place not in records and taken_by(cut) is not None:
            records[place] = cut
    ordered = [records[place] for place in sorted(records)]
    for record in ordered:
        for stream, emission in zip(streams, record.outputs, strict=False):
            if emission is not None and emission.seq != WITHHELD:
                held.pop((stream, record.incarnation, emission.seq), None)
    return holding(ordered, [held[place] for place in sorted(held)])


def holding(records: Sequence[FiringRecord], held: Sequence[Held]) -> list[FiringRecord]:
    """The records, with one that accounts for messages whose own are missing, in place of what others said of them."""
    lists = [list(message) for message in held]
    first = next((k for k, r in enumerate(records) if r.kind == "cut"), None)
    made = [
        r if r.kind != "cut" else replace(r, detail={**r.detail, "held": lists if k == first else []})
        for k, r in enumerate(records)
    ]
    if held and first is None and made:
        last = made[-1]
        after = FiringRecord(last.operator, last.incarnation, last.index + 1, "cut", last.stamp)
        made.append(cut_record(after, left_out=0, taken=None, held=held, stamp=last.stamp))
    return made
