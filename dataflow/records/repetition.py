"""Chooses what of an operator's records is repeated, and counts it: the records are read twice, and not kept."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping

from dataflow.records.cuts import StateKnowledge, code_in, is_known
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import Repeatable, note_taken
from dataflow.sync import Uses


class Repetition:
    """The records of one operator that are repeated, from a place in the middle on if asked. `look_at` finds the place
    and counts; iterating reads them.

    With `begin` that place is after the last recorded state at or before that stamp, or at `begin` itself for an
    operator without state; for any other at the start, since its state in the middle is not known.

    - `setup`: the record of the first `setup()`; None where it is lost.
    - `before`: of the records in front of that place those that changed the operator, and the last one.
    - `began`: how the place was found: start, snapshot or stateless.
    - `calls`: number of calls to be repeated. `lost` ones follow missing records, and `unknown` ones a cut at which the
      state is not known: neither can be.
    - `uses`: how often these calls take each message; `needed`: by stream the first one (incarnation, number).
    """

    def __init__(
        self, records: Callable[[], Iterable[FiringRecord]], *, begin: int | None = None, stateless: bool
    ) -> None:
        """`records` reads the records in the order of the calls, each once."""
        self._records, self._begin, self._stateless = records, begin, stateless
        self._skipped = 0
        self.began = "start"
        self.setup: FiringRecord | None = None
        self.before: list[FiringRecord] = []
        self.calls = self.lost = self.unknown = 0
        self.uses = Uses()
        self.needed: dict[str, tuple[int, int]] = {}
        self._code: dict[int, Mapping[str, str]] = {}

    def code_of(self, incarnation: int) -> Mapping[str, str] | None:
        """Returns the digests, by module, of an incarnation's code where that of the last one differs; else None."""
        at = max((each for each in self._code if each <= incarnation), default=None)
        return None if at is None or self._code[at] == self._code[max(self._code)] else self._code[at]

    def __iter__(self) -> Iterator[FiringRecord]:
        knowledge = StateKnowledge()
        for number, record in self._numbered():
            if number is not None and number >= self._skipped:
                kept = record if self._stateless else knowledge.of(record)
                if kept is not None:
                    yield kept

    def _numbered(self) -> Iterator[tuple[int | None, FiringRecord]]:
        """The records, numbered behind the first `setup()`, which is -1; those that cannot be repeated have none."""
        following, follower = -1, Repeatable()
        for record in self._records():
            known = follower.take(record)
            if known:
                following = 0 if following < 0 and record.kind != "setup" else following
                yield following, record
                following += 1
            elif known is not None:
                yield None, record

    def looking(self) -> Iterator[tuple[int, int]]:
        """Reads the records once, and once more before where a place in the middle is looked for. Yields which time it
        is and the stamp of the record."""
        if self._begin is not None:
            for place, stamp in self._placing(self._begin):
                self._skipped = place
                yield 0, stamp
            if self._stateless or self._skipped:
                self.began = "stateless" if self._stateless else "snapshot"
        knowledge = StateKnowledge()
        for number, record in self._numbered():
            if (code := code_in(record)) is not None:
                self._code[record.incarnation] = code
            if number is None:
                self.lost += record.kind in CALLS
            elif number < 0:
                self.setup = record
            elif number >= self._skipped:
                self._count(record, record if self._stateless else knowledge.of(record))
            elif record.kind in ("setup", "param", "cut") or number == self._skipped - 1:
                self.before.append(record)
            yield 1, record.stamp

    def _placing(self, begin: int) -> Iterator[tuple[int, int]]:
        """Yields the number of the record at which the repetition begins, as far as the records up to this one show,
        and its stamp."""
        place = 0
        for number, record in self._numbered():
            if number is not None and number >= 0:
                if not self._stateless:
                    place = number + 1 if is_known(record) and record.stamp <= begin else place
                elif record.kind in CALLS and record.stamp >= begin:
                    yield number, record.stamp
                    return
                else:
                    place = number + 1
            yield place, record.stamp

    def _count(self, record: FiringRecord, kept: FiringRecord | None) -> None:
        if kept is None:
            self.unknown += record.kind in CALLS
            return
        note_taken(self.needed, kept)
        if kept.kind in CALLS:
            self.calls += 1
            self.uses.add(kept.inputs)


def look_at(repetitions: Iterable[Repetition]) -> None:
    """Reads the records of several operators side by side: they lie in the same chunks, so these are decompressed
    once."""
    for _ in heapq.merge(*(repetition.looking() for repetition in repetitions)):
        pass
