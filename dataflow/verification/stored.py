"""Compares stored messages with the digests in the firing records of the operators that made them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, takewhile
from typing import Any

from dataflow.records.order import Place

Recorded = Callable[[], Iterable[tuple[Place, bytes]]]


@dataclass(slots=True)
class StoredStream:
    """The messages of one stream in a recording against the firing records of its maker.

    `changed` stored messages have another digest than the records say, `uncalled` ones are of no record, or are stored
    twice; `missing` ones are in the records and not in the stream. The places are those of the first of each.
    """

    stream: str
    maker: str
    changed: int = 0
    uncalled: int = 0
    missing: int = 0
    first_changed: Place | None = None
    first_uncalled: Place | None = None
    first_missing: Place | None = None

    @property
    def as_recorded(self) -> bool:
        """Every stored message is one in its maker's records. Missing ones may never have been sent."""
        return not (self.changed or self.uncalled)

    def to_wire(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> StoredStream:
        """Restores an object from the values of `to_wire` after an encoding without tuples."""
        first = {name: tuple(values[name]) for name in values if name.startswith("first") and values[name] is not None}
        return StoredStream(**{**values, **first})


class StoredCheck:
    """Checks one stream, message by message: quickest in the order of its messages, but they may come in any.

    `recorded` reads (place, digest) of what the records say was sent, in the order of the places. Of it there is in
    memory what was passed over. `whole`: the stream is read from its beginning; else what is missing counts from the
    first message on, and what lies before it is read again if it is asked for.
    """

    def __init__(self, stream: str, maker: str, recorded: Recorded, *, static: bool, whole: bool) -> None:
        self._result = StoredStream(stream, maker)
        self._recorded = recorded
        self._ahead = iter(recorded())
        self._next = next(self._ahead, None)
        self._passed: dict[Place, bytes] = {}
        self._static, self._whole = static, whole
        self._first: Place | None = None
        self._begin: Place | None = None
        """The place before which nothing that was passed over is in memory."""

    def take(self, place: Place, digest: bytes) -> None:
        """Compares a stored message, known by its place in the stream."""
        result = self._result
        if self._first is None and not self._whole:
            self._begin = place
            self._next = next((sent for sent in chain(self._rest(), self._ahead) if sent[0] >= place), None)
        if self._first is None or place < self._first:
            self._first = place
        expected = self._expected(place)
        if expected is None:
            result.uncalled += 1
            if result.first_uncalled is None or place < result.first_uncalled:
                result.first_uncalled = place
        elif expected != digest:
            result.changed += 1
            if result.first_changed is None or place < result.first_changed:
                result.first_changed = place

    def _expected(self, place: Place) -> bytes | None:
        """The recorded digest of a message that was not taken before."""
        begin = self._begin
        if begin is not None and place < begin:
            self._passed |= takewhile(lambda sent: sent[0] < begin, self._recorded())
            self._begin = None
        while self._next is not None and self._next[0] < place:
            self._passed[self._next[0]] = self._next[1]
            self._next = next(self._ahead, None)
        if self._next is None or self._next[0] != place:
            return self._passed.pop(place, None)
        digest, self._next = self._next[1], next(self._ahead, None)
        return digest

    def _rest(self) -> Sequence[tuple[Place, bytes]]:
        """Returns the next of `_ahead` that was read already, if any."""
        return () if self._next is None else (self._next,)

    def result(self) -> StoredStream:
        """The outcome, once every message was taken. A static stream is recorded once, however often it was made."""
        if not (self._static and self._first is not None):
            for place in chain(sorted(self._passed), (p for p, _ in chain(self._rest(), self._ahead))):
                if self._whole or (self._first is not None and place > self._first):
                    self._result.missing += 1
                    self._result.first_missing = self._result.first_missing or place
        return self._result
