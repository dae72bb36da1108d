"""Counts messages that ROS publishers sent and that never came, by the numbers in their attachments. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

from dataflow.ros.wire import Attachment

_K = TypeVar("_K")
_V = TypeVar("_V")

MOST_GAPS = 256
"""Gaps of a publisher in which a message may still arrive; older ones stay lost."""
MOST_KNOWN = 4096
"""Publishers, and what else is known by name, that are remembered; for new ones, the longest unseen are forgotten."""


@dataclass(slots=True)
class Numbered:
    """A publisher's numbers: the next one, the time of the newest message, and what is missing (first, last + 1)."""

    next: int
    time: int
    received: int = 1
    lost: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list)


class Losses:
    """The publishers of a topic, by gid. A publisher that is new begins with whatever number comes first."""

    def __init__(self) -> None:
        self.publishers: dict[bytes, Numbered] = {}
        self.lost = 0
        """Messages that are missing, of all publishers."""

    def take(self, seen: Attachment) -> int:
        """Takes note of a message; returns how many are missing directly before it.

        A number that comes late fills its gap. One that lies behind and was published later is of a publisher that has
        begun anew under its old gid; one that goes on counts whatever its time, since its clock may have been set.
        """
        known = self.publishers.get(seen.gid)
        remember(self.publishers, seen.gid, known or Numbered(seen.number + 1, seen.time))
        if known is None:
            return 0
        late = seen.number < known.next and seen.time <= known.time
        if late and not self._fill(known, seen.number):
            return 0  # sent twice, as history and as it came
        known.received += 1
        if late:
            return 0
        missing = max(0, seen.number - known.next)
        if seen.number < known.next:
            known.gaps.clear()
        elif missing:
            known.lost += missing
            self.lost += missing
            known.gaps = [*known.gaps[1 - MOST_GAPS :], (known.next, seen.number)]
        known.next, known.time = seen.number + 1, seen.time
        return missing

    def _fill(self, known: Numbered, number: int) -> bool:
        for place, (first, end) in enumerate(known.gaps):
            if first <= number < end:
                parts = ((first, number), (number + 1, end))
                known.gaps[place : place + 1] = [part for part in parts if part[0] < part[1]]
                known.lost -= 1
                self.lost -= 1
                return True
        return False


def remember(known: dict[_K, _V], key: _K, value: _V) -> None:
    """Puts an entry at the end, and forgets the first where there are too many."""
    known.pop(key, None)
    known[key] = value
    if len(known) > MOST_KNOWN:
        del known[next(iter(known))]
