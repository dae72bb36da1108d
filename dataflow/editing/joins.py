"""Firing records of several parts of one run, joined into one log."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

from dataflow.records.cuts import OrphanedMessage, cut_record, held_by, taken_by
from dataflow.records.firing import WITHHELD, FiringRecord
from dataflow.records.order import Place


@dataclass(frozen=True, slots=True)
class Joined:
    """The records of one operator that any of `parts` holds, in order: read whenever they are iterated over.

    `parts`: its records in each, by (incarnation, index), read whenever they are iterated over; `streams`: those of its
    ports. A `cut` stays where the records that it stands in for are in none of them.
    """

    parts: Sequence[Iterable[FiringRecord]]
    streams: Sequence[str]

    def __iter__(self) -> Iterator[FiringRecord]:
        held: dict[tuple[str, int, int], OrphanedMessage] = {}
        for part in self.parts:
            for record in part:
                held |= {(h.stream, *h.place): h for h in held_by(record)}
        for record in self._chosen() if held else ():
            for stream, emission in zip(self.streams, record.outputs, strict=False):
                if emission is not None and emission.seq != WITHHELD:
                    held.pop((stream, record.incarnation, emission.seq), None)
        return holding(self._chosen(), [held[place] for place in sorted(held)])

    def _chosen(self) -> Iterator[FiringRecord]:
        """The records, each once; a `cut` only where it is needed."""
        for _, alike in groupby(heapq.merge(*self.parts, key=_place), key=_place):
            chosen: FiringRecord | None = None
            for record in alike:
                if chosen is None or (chosen.kind == "cut" and (record.kind != "cut" or "state" in record.detail)):
                    chosen = record
            if chosen is not None and (chosen.kind != "cut" or taken_by(chosen) is not None):
                yield chosen


def _place(record: FiringRecord) -> Place:
    return record.incarnation, record.index


def holding(records: Iterable[FiringRecord], held: Sequence[OrphanedMessage]) -> Iterator[FiringRecord]:
    """The records, with one that accounts for messages whose own are missing, in place of what others said of them."""
    lists = [list(message) for message in held]
    last: FiringRecord | None = None
    cut = False
    for record in records:
        last = record
        if record.kind == "cut":
            last = replace(record, detail={**record.detail, "held": [] if cut else lists})
            cut = True
        yield last
    if held and not cut and last is not None:
        after = FiringRecord(last.operator, last.incarnation, last.index + 1, "cut", last.stamp)
        yield cut_record(after, left_out=0, taken=None, held=held, stamp=last.stamp)
