"""Finds operators that write into messages that they were given: the memory of a message is one for all its readers.

Its arrays are read-only, but libraries need not look at that (LAPACK with `overwrite_a`, code called by its address).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dataflow.messages.base import Message
from dataflow.sync import Firing
from dataflow.sync.entries import entries_of

WATCHED = 3
"""The first firings of each operator, in which it is always watched: most that write into an input do so each time."""
_KEPT = 16
"""Messages that were given before, and are watched on: an operator may keep them."""


@dataclass(slots=True)
class _Given:
    """A message that operators were given: by operator the input and the stamp of the first firing that had it; its
    digest; which of them has written into it, if any."""

    message: Message
    digest: bytes
    to: dict[str, tuple[str, int]] = field(default_factory=dict)
    writer: str = ""


class MemoryGuard:
    """Compares what calls are given before and after. `keeping`: also the last messages that calls before were given,
    to that operator or another one that shares the guard."""

    def __init__(self, *, keeping: bool = False) -> None:
        self.keeping = keeping
        self.reached: dict[str, tuple[str, int]] = {}
        """Operators that were given a message into which another one wrote, before or after: that other operator, and
        the stamp of the first firing with such a message."""
        self._given: dict[int, _Given] = {}

    def take(self, operator: str, firing: Firing) -> None:
        """To be called before a call, with what it is given."""
        self._given = dict(list(self._given.items())[-_KEPT:]) if self.keeping else {}
        for name, given in firing.inputs.items():
            for entry in entries_of(given):
                message: Message = entry.value
                known = self._given.pop(id(message), None) or _Given(message, message.compute_digest())
                self._given[id(message)] = known
                known.to.setdefault(operator, (name, firing.stamp))
                self._reach(known)

    def changed(self, operator: str) -> str:
        """To be called after the call: the first message whose memory is not what it was, in words, or nothing."""
        said = ""
        for known in self._given.values():
            if (digest := known.message.compute_digest()) != known.digest:
                known.digest, known.writer = digest, operator
                self._reach(known)
                said = said or _words(operator, known)
        return said

    def _reach(self, known: _Given) -> None:
        if known.writer:
            for name in known.to.keys() - {known.writer}:
                at = known.to[name][1]
                if at < self.reached.get(name, ("", at + 1))[1]:
                    self.reached[name] = known.writer, at


def _words(operator: str, known: _Given) -> str:
    owner = operator if operator in known.to else next(iter(known.to))
    name = known.to[owner][0]
    whose = f"its input {name!r}" if owner == operator else f"the input {name!r} of {owner}"
    return f"{whose} ({known.message.SCHEMA} at stamp {known.message.stamp})"
