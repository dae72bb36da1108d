"""Corrects the stamps of a source by the measured offset of its machine's clock."""

from __future__ import annotations

SLEW = 1000
"""A new offset is approached by one nanosecond in so many: faster than quartz drifts, and stamps keep their order."""
JUMP = 100_000_000
"""Nanoseconds of difference from which on a clock was set, and the new offset holds at once."""


class ClockCorrection:
    """Turns stamps of another machine's clock into the supervisor's. `measured` may be called on any thread."""

    def __init__(self) -> None:
        self._measured: int | None = None
        self._shift: int | None = None
        self._last = 0

    def measured(self, offset: int) -> None:
        """Takes by how much this machine's clock is ahead of the supervisor's (ns)."""
        self._measured = offset

    def shift(self, stamp: int) -> int:
        """Returns what is to be added to a stamp (ns); 0 until an offset was measured."""
        if self._measured is None:
            return 0
        wanted, most = -self._measured, max(0, stamp - self._last) // SLEW
        if self._shift is None or abs(wanted - self._shift) > JUMP:
            self._shift = wanted
        else:
            self._shift += min(most, max(-most, wanted - self._shift))
        self._last = stamp
        return self._shift
