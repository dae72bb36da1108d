"""Counts messages that ROS publishers sent and that never came, by the numbers in their attachments. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

from dataflow.ros.wire import Attachment

MOST_GAPS = 256
"""Gaps of a publisher in which a message may still arrive; older ones stay lost."""


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

    @property
    def lost(self) -> int:
        """Messages that are missing, of all publishers."""
        return sum(publisher.lost for publisher in self.publishers.values())

    def take(self, seen: Attachment) -> int:
        """Takes note of a message; returns how many are missing directly before it.

        A number that comes late fills its gap. One that lies behind and was published later is of a publisher that has
        begun anew under its old gid.
        """
        known = self.publishers.get(seen.gid)
        if known is None:
            self.publishers[seen.gid] = Numbered(seen.number + 1, seen.time)
            return 0
        late = seen.time <= known.time
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
            known.gaps = [*known.gaps[1 - MOST_GAPS :], (known.next, seen.number)]
        known.next, known.time = seen.number + 1, seen.time
        return missing

    @staticmethod
    def _fill(known: Numbered, number: int) -> bool:
        for place, (first, end) in enumerate(known.gaps):
            if first <= number < end:
                parts = ((first, number), (number + 1, end))
                known.gaps[place : place + 1] = [part for part in parts if part[0] < part[1]]
                known.lost -= 1
                return True
        return False
