"""Finds operators that write into messages that they were given: the memory of a message is one for all its readers.

Its arrays are read-only, but libraries need not look at that (LAPACK with `overwrite_a`, code called by its address).
"""

from __future__ import annotations

from dataflow.messages.base import Message
from dataflow.sync import Firing
from dataflow.sync.entries import entries_of

WATCHED = 3
"""The first firings of each operator, in which it is always watched: most that write into an input do so each time."""
_KEPT = 16
"""Messages that were given before, and are watched on: an operator may keep them."""


class MemoryGuard:
    """Compares what calls are given before and after. `keeping`: also the last messages that calls before were given,
    to that operator or another one that shares the guard."""

    def __init__(self, *, keeping: bool = False) -> None:
        self.keeping = keeping
        self._taken: dict[int, tuple[dict[str, str], Message, bytes]] = {}

    def take(self, operator: str, firing: Firing) -> None:
        """To be called before a call, with what it is given."""
        self._taken = dict(list(self._taken.items())[-_KEPT:]) if self.keeping else {}
        for name, given in firing.inputs.items():
            for entry in entries_of(given):
                message: Message = entry.value
                if id(message) not in self._taken:
                    self._taken[id(message)] = {}, message, message.compute_digest()
                self._taken[id(message)][0].setdefault(operator, name)

    def changed(self, operator: str) -> str:
        """To be called after the call: the first message whose memory is not what it was, in words, or nothing."""
        found = [key for key, (_, message, digest) in self._taken.items() if message.compute_digest() != digest]
        said = [self._words(operator, *self._taken.pop(key)) for key in found]
        return said[0] if said else ""

    def _words(self, operator: str, names: dict[str, str], message: Message, _: bytes) -> str:
        """`names`: of the inputs by which operators were given the message, the first of them first."""
        owner = operator if operator in names else next(iter(names))
        whose = f"its input {names[owner]!r}" if owner == operator else f"the input {names[owner]!r} of {owner}"
        return f"{whose} ({message.SCHEMA} at stamp {message.stamp})"
