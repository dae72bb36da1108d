"""Stores the latest measurements of each sensor and their consistency, for the fusion operators."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Generic, TypeVar

from dataflow.messages import Diagnostics, Message
from dataflow.operator import Remembered
from operators.fusion.redundant.agreement import Agreement

M = TypeVar("M", bound=Message)
_REPORTED = 1_000_000_000


class RedundantSensors(Remembered, Generic[M]):
    """Keeps each sensor's newest message for `window` (ns); `share`: of true ones that count as no contradiction."""

    agreement: Agreement
    ignored: Counter[str]
    _newest: dict[str, M]
    _reported: int

    def __init__(self, window: int, share: float) -> None:
        self._window, self._newest, self._reported = window, {}, -1
        self.agreement, self.ignored = Agreement(share), Counter()

    def take(self, messages: Mapping[str, M]) -> None:
        """Takes messages by stream; one that is not later than the sensor's last is ignored and counted."""
        for stream, message in sorted(messages.items()):
            name = stream.partition("/")[2]
            last = self._newest.get(name)
            if last is not None and message.stamp <= last.stamp:
                self.ignored[f"{name}: stamp not later than the last"] += 1
            else:
                self._newest[name] = message

    def simultaneous(self, stamp: int) -> Iterator[tuple[str, M]]:
        """Yields name and message of every sensor whose last is at most `window` old at a stamp."""
        for name, message in sorted(self._newest.items()):
            if 0 <= stamp - message.stamp <= self._window:
                yield name, message

    def status(self, stamp: int) -> Diagnostics | None:
        """Returns a status every second, and at once when sensors contradict each other; None between."""
        if self._reported >= 0 and stamp - self._reported < _REPORTED and not self.agreement.doubted:
            return None
        self._reported = stamp
        return self.agreement.status(stamp, self.ignored)

    def summary(self) -> dict[str, float | int | str]:
        figures: dict[str, float | int | str] = {"two sensors contradicted each other": self.agreement.split}
        return figures | {f"ignored, {reason}": count for reason, count in sorted(self.ignored.items())}
