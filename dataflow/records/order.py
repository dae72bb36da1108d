"""The order of an operator's calls, where its firing records lie in a file otherwise.

They mostly lie in that order. When a process dies, records that it had not sent are stored after those of others, and
some of them a second time; each part of a recording begins with what stands in for those before. The records are then a
few *runs*, each in order, which are merged: one is read once it is its turn.
"""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dataflow.records.cuts import held_by
from dataflow.records.firing import KINDS, FiringRecord, Rows, decode_rows

Place = tuple[int, int]
"""(incarnation, number) of a message in its stream, or (incarnation, index) of a record."""
STEP = 8
"""Batches between two at which reading can begin."""
_CUT = KINDS.index("cut")
Read = Callable[[int, int | None], Iterator[FiringRecord]]
"""Reads the records of the batches from one number to before another."""


@dataclass(frozen=True, slots=True)
class Run:
    """The batches `begin` to `end` - 1 of an operator, whose records are in order; `first` is the place of the first of
    them. `steps`: some of these batches with their first places, so that reading can begin on the way."""

    begin: int
    end: int
    first: Place
    steps: tuple[tuple[Place, int], ...] = ()

    def since(self, place: Place) -> Run:
        """Returns the run without some of what lies before a place."""
        at = bisect_right(self.steps, (place, self.end))
        return replace(self, begin=self.steps[at - 1][1], first=self.steps[at - 1][0]) if at else self


@dataclass(frozen=True, slots=True)
class Outline:
    """The layout of an operator's records in a file. `scattered`: streams whose messages do not increase in number from
    record to record, or of which records contradict each other."""

    runs: tuple[Run, ...] = ()
    scattered: frozenset[str] = frozenset()

    def to_wire(self) -> dict[str, Any]:
        return {"runs": [(r.begin, r.end, *r.first) for r in self.runs], "scattered": sorted(self.scattered)}

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> Outline:
        runs = tuple(Run(begin, end, (incarnation, index)) for begin, end, incarnation, index in values["runs"])
        return Outline(runs, frozenset(values["scattered"]))


class Outliner:
    """Finds the outline of the records of one operator with the streams `outputs`, in declared order."""

    def __init__(self, outputs: Sequence[str]) -> None:
        self._outputs = outputs
        self._runs: list[Run] = []
        self._last: Place = (-1, -1)
        self._first: Place = (-1, -1)
        self._begin = self._end = 0
        self._steps: list[tuple[Place, int]] = []
        self._repeats = False
        """The newest run has only what came before already, so far."""
        self._newest: dict[str, Place] = dict.fromkeys(outputs, (-1, -1))
        self._scattered: set[str] = set()

    @property
    def in_order(self) -> bool:
        """Returns whether all records so far are in order, until `done`."""
        return not self._runs

    def take(self, number: int, record: FiringRecord) -> None:
        """Takes the next record of the file, which is in batch `number`."""
        self._follow(number, (record.incarnation, record.index))
        self._rise(record)

    def take_batch(self, number: int, batch: Rows) -> None:
        """Takes the records of the next batch of the file, of which no more is decoded than is needed."""
        if any(row[0] == _CUT for row in batch.rows):
            for record in decode_rows(batch):
                self.take(number, record)
            return
        life = batch.incarnation
        for index, row in enumerate(batch.rows, batch.first):
            self._follow(number, (life, index))
            made = zip(self._outputs, row[6])  # noqa: B905 - a failed call has none
            self._rise_to((stream, (life, e[0])) for stream, e in made if e is not None and e[0] >= 0)

    def _follow(self, number: int, place: Place) -> None:
        last = self._last
        back = place <= last
        if back or (self._repeats and place > (last[0], last[1] + 1)):
            self._runs.append(Run(self._begin, number, self._first, tuple(self._steps)))
            self._begin, self._first, self._repeats = number, place, back
            self._steps.clear()
        elif last == (-1, -1):
            self._begin, self._first = number, place
        elif number >= self._end and number >= (self._steps[-1][1] if self._steps else self._begin) + STEP:
            self._steps.append((place, number))
        self._last, self._end = place, number + 1

    def _rise(self, record: FiringRecord) -> None:
        if record.kind == "cut":
            self._rise_to((stream, at) for stream, at, _ in emitted(record, self._outputs))
        else:
            life = record.incarnation
            made = zip(self._outputs, record.outputs)  # noqa: B905 - a failed call has none
            self._rise_to((stream, (life, e.seq)) for stream, e in made if e is not None and e.seq >= 0)

    def _rise_to(self, sent: Iterable[tuple[str, Place]]) -> None:
        newest = self._newest
        for stream, at in sent:
            if at <= newest[stream]:
                self._scattered.add(stream)
            newest[stream] = at

    def done(self, read: Read) -> Outline:
        """Returns the outline. `read` is needed where there are several runs."""
        if self._end:
            self._runs.append(Run(self._begin, self._end, self._first, tuple(self._steps)))
        if len(self._runs) > 1:
            self._newest = dict.fromkeys(self._outputs, (-1, -1))
            self._scattered = set()
            before: FiringRecord | None = None
            for record in merged(self._runs, read):
                if before is not None and (record.incarnation, record.index) == (before.incarnation, before.index):
                    if record.kind != "cut" and record.outputs != before.outputs:
                        self._scattered.update(self._outputs)
                    continue
                before = record
                self._rise(record)
        return Outline(tuple(self._runs), frozenset(self._scattered))


def emitted(record: FiringRecord, outputs: Sequence[str]) -> Iterator[tuple[str, Place, bytes]]:
    """(stream, place, digest) of every message that a record accounts for as sent."""
    for stream, emission in zip(outputs, record.outputs, strict=False):  # a failed call has none
        if emission is not None and emission.seq >= 0:
            yield stream, (record.incarnation, emission.seq), emission.digest
    if record.kind == "cut":
        for held in held_by(record):
            if held.stream in outputs:
                yield held.stream, held.place, held.digest


def merged(runs: Sequence[Run], read: Read) -> Iterator[FiringRecord]:
    """The records of some runs by (incarnation, index); of equal ones, that of the earlier run first."""
    if len(runs) == 1:
        yield from read(runs[0].begin, runs[0].end)
        return
    waiting = deque(sorted(enumerate(runs), key=lambda item: (item[1].first, item[0])))
    heads: list[tuple[Place, int, FiringRecord, Iterator[FiringRecord]]] = []

    def push(number: int, left: Iterator[FiringRecord]) -> None:
        record = next(left, None)
        if record is not None:
            heapq.heappush(heads, ((record.incarnation, record.index), number, record, left))

    while waiting or heads:
        while waiting and (not heads or waiting[0][1].first <= heads[0][0]):
            number, run = waiting.popleft()
            push(number, read(run.begin, run.end))
        _, number, record, left = heapq.heappop(heads)
        yield record
        push(number, left)


def in_order(runs: Sequence[Run], read: Read) -> Iterator[FiringRecord]:
    """The records of some runs by (incarnation, index), each once: handed over twice are those of a process that
    died."""
    last: Place = (-1, -1)
    for record in merged(runs, read):
        place = (record.incarnation, record.index)
        if place > last:
            last = place
            yield record
