"""Corrects the stamps of a source by the measured offset of its machine's clock."""

from __future__ import annotations

SLEW = 1000
"""A new offset is approached by one nanosecond in so many: faster than quartz drifts, and stamps keep their order."""
JUMP = 100_000_000
"""Nanoseconds by which a new offset differs beyond what the delays explain: a clock was set, and it holds at once."""


class ClockCorrection:
    """Turns stamps of another machine's clock into the supervisor's. `measured` may be called on any thread."""

    def __init__(self) -> None:
        self._measured: tuple[int, int] | None = None
        self._set, self._followed = 0, 0
        self._shift = 0
        self._last = 0

    def measured(self, offset: int, delay: int) -> None:
        """Takes by how much this machine's clock is ahead of the supervisor's (ns), at most half of `delay` wrong."""
        before, self._measured = self._measured, (offset, delay)
        if before is None or abs(offset - before[0]) > JUMP + (delay + before[1]) // 2:
            self._set += 1

    def shift(self, stamp: int) -> int:
        """Returns what is to be added to a stamp (ns); 0 until an offset was measured."""
        if self._measured is None:
            return 0
        times, wanted, most = self._set, -self._measured[0], max(0, stamp - self._last) // SLEW
        if times != self._followed:
            self._shift, self._followed = wanted, times
        else:
            self._shift += min(most, max(-most, wanted - self._shift))
        self._last = stamp
        return self._shift
