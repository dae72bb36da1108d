"""The last calls of an operator that were made here, kept in memory: to be shown, and to be made again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from dataflow.debugging.fired import Call, States, call_of
from dataflow.messages.base import Message
from dataflow.records.firing import FiringRecord
from dataflow.sync import Entry, Firing
from dataflow.sync.entries import entries_of

MOST_CALLS = 256
MOST_BYTES = 2**29
"""Of the messages that the kept calls were given and made."""


@dataclass(slots=True)
class CachedCall:
    """A call that was made here: its record, what it was given, what came out. `firing` is None where a fault was tried
    out in place of the call.

    `changed`: parameters that were changed by then. `states`: None where they were not taken. `stale`: it was not made
    to its end, something may have been changed in it by hand, or its source has been edited since.
    """

    number: int
    record: FiringRecord
    firing: Firing | None
    outputs: Mapping[str, Message]
    raised: BaseException | None
    same: bool
    changed: Mapping[str, Any]
    states: States | None
    stale: bool = False

    @property
    def call(self) -> Call:
        """Returns the call of the record."""
        return call_of(self.record)

    def entries(self) -> Iterator[Entry]:
        """Yields the entries of all inputs."""
        for given in () if self.firing is None else self.firing.inputs.values():
            yield from entries_of(given)

    def messages(self) -> Iterator[Message]:
        """Yields the messages of all inputs and outputs."""
        yield from chain((entry.value for entry in self.entries()), self.outputs.values())


class Ring:
    """The last calls, up to `MOST_CALLS` and `most_bytes`, by their number."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._held: dict[int, CachedCall] = {}
        self._holders: Counter[bytes] = Counter()
        self._nbytes = 0

    def get(self, number: int) -> CachedCall | None:
        """The call of that number, if it is kept."""
        return self._held.get(number)

    def add(self, held: CachedCall) -> None:
        """Keeps a call, in place of what was kept of it; lets the oldest ones go."""
        self.drop(held.number)
        self._held[held.number] = held
        self._count(held, 1)
        while len(self._held) > MOST_CALLS or (self._nbytes > self._most_bytes and len(self._held) > 1):
            self.drop(next(iter(self._held)))

    def drop(self, number: int) -> None:
        """Lets a call go."""
        if (held := self._held.pop(number, None)) is not None:
            self._count(held, -1)

    def leave_only(self, number: int | None) -> None:
        """Lets all calls go but one, which is stale from now on."""
        for each in [n for n in self._held if n != number]:
            self.drop(each)
        for held in self._held.values():
            held.stale = True

    def way_to(self, number: int, states: Collection[int]) -> Sequence[CachedCall]:
        """The calls from the last one at or before `number` in front of which a state is known, to `number`; empty
        where one of them is not kept."""
        way: list[CachedCall] = []
        while (held := self._held.get(number)) is not None and held.firing is not None:
            if way and not way[-1].call.follows(held.call):
                return ()
            way.append(held)
            if number in states:
                return way[::-1]
            number -= 1
        return ()

    def _count(self, held: CachedCall, by: int) -> None:
        for message in held.messages():
            digest = message.digest()
            self._holders[digest] += by
            if self._holders[digest] == (1 if by > 0 else 0):
                self._nbytes += by * message.nbytes()
            if not self._holders[digest]:
                del self._holders[digest]
