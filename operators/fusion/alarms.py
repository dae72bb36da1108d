"""Alarms of a fusion: which sensors contradict the rest, made it yield, come too late, or are of no use."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.operator import Remembered
from operators.fusion.filter.error_state_filter import TOO_LATE
from operators.fusion.filter.gate import GateConfig, Health
from operators.fusion.sensors.settings import never_yields

_ANY = GateConfig()
_RECENT = 2_000_000_000
"""Nanoseconds for which an alarm stands after its cause."""


class Alarms(Remembered):
    """Decides when a status is due: every second, and at once where there is a new alarm."""

    _reported: int
    _raised: set[str]
    _late: dict[str, tuple[int, int]]
    _useless: dict[str, tuple[int, str]]

    def __init__(self) -> None:
        self._reported, self._raised, self._late, self._useless = -1, set(), {}, {}

    def of_use(self, name: str) -> None:
        """Takes note that a sensor's message gave measurements."""
        self._useless.pop(name, None)

    def of_no_use(self, name: str, reason: str) -> None:
        """Takes note that a sensor's message gave none."""
        self._useless[name] = self._useless.get(name, (0, ""))[0] + 1, reason

    def due(
        self,
        stamp: int,
        health: Mapping[str, Health],
        ignored: Mapping[str, int],
        gates: Mapping[str, GateConfig],
        others: Mapping[str, str],
    ) -> dict[str, str] | None:
        """Returns the text of each alarm at a time (ns) if a status is due, which counts as given then.

        `ignored` counts what was passed over; sensors whose gate never yields may be refused; `others` are alarms
        that are of no sensor's measurements.
        """
        standing = {**self._standing(stamp, health, ignored, gates), **others}
        fresh = not self._raised.issuperset(standing)
        self._raised = set(standing)
        if self._reported >= 0 and stamp - self._reported < 10**9 and not fresh:
            return None
        self._reported = stamp
        return standing

    def _standing(
        self, stamp: int, health: Mapping[str, Health], ignored: Mapping[str, int], gates: Mapping[str, GateConfig]
    ) -> dict[str, str]:
        found = {name: f"of no use: {reason}" for name, (times, reason) in self._useless.items() if times > 1}
        for name, h in health.items():
            if h.room is not None and stamp - h.room <= _RECENT:
                found[name] = "the filter made room for it: one of them was wrong"
            elif h.contradicts and h.doubts and not never_yields(gates.get(name.partition(" ")[0], _ANY)):
                recent = stamp - h.doubts[-1].time <= _RECENT
                text = "contradicts the others"
                if h.frozen:
                    text = "frozen: it repeats a position that the body has left"
                elif h.leap:
                    text += ": it leapt, and the inertial sensor felt nothing"
                found |= {name: text} if recent else {}
        for key, count in ignored.items():
            if key.endswith(TOO_LATE):
                before, since = self._late.get(key, (0, stamp))
                if count > before:
                    self._late[key] = count, (since := stamp)
                if stamp - since <= _RECENT:
                    found[key.removesuffix(TOO_LATE)] = f"too late: {count} came after the window"
        return found
