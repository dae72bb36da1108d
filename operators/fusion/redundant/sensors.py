"""Redundant sensors: their latest measurements, noise that follows innovations, and what is not to be averaged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Message
from dataflow.messages.diagnostics import Level
from dataflow.operator import Remembered
from operators.fusion.redundant.combination import contradicts
from operators.status import Row, status_of_rows

T = TypeVar("T")
M = TypeVar("M", bound=Message)
Array = NDArray[np.float64]
_REPORTED = 1_000_000_000
_SMOOTH, _SUDDEN, _LARGEST = 0.05, 20.0, 100.0


class Agreement(Remembered):
    """Follows how far each sensor is from the others: `noise` is by how much its covariance is too small.

    Of three or more sensors one that contradicts the others is left out. Of two it is undecidable which is wrong: both
    stay, and the result's covariance has to hold both. Innovation-based adaptation: Mehra, 1970.
    """

    split: int
    _noise: dict[str, float]
    _doubted: Counter[str]
    _used: Counter[str]

    def __init__(self, share: float) -> None:
        self._share, self._noise, self.split = share, {}, 0
        self._doubted, self._used = Counter(), Counter()

    def noise(self, sensor: str) -> float:
        """Returns the factor, 1 or more, on a sensor's covariance."""
        return max(1.0, self._noise.get(sensor, 1.0))

    def judge(
        self,
        names: Sequence[str],
        seen: Sequence[T],
        consistency: Callable[[Sequence[T]], tuple[float, int]],
        misfits: Callable[[Sequence[T]], Array],
    ) -> tuple[list[T], float]:
        """Returns what is to be combined, and the factor by which the result's covariance grows.

        `consistency`: squared residuals of all about what they say together, and their degrees of freedom; `misfits`:
        squared distances of each from the others, over those explained.
        """
        kept, left, growth = list(names), list(seen), 1.0
        while contradicts(together := consistency(left), self._share):
            if len(left) == 2:
                growth = together[0] / together[1]
                self.split += 1
                self._doubted.update(kept)
                break
            wrong = self._wrong(left, consistency)
            self._doubted[kept[wrong]] += 1
            self._follow(kept[wrong], _SUDDEN)
            del kept[wrong], left[wrong]
        if len(left) > 2:
            for name, value in zip(kept, misfits(left).tolist(), strict=True):
                self._follow(name, value)
        self._used.update(kept)
        return left, growth

    def _wrong(self, seen: Sequence[T], consistency: Callable[[Sequence[T]], tuple[float, int]]) -> int:
        """The one without which the others agree, as far as they can be compared, and best."""
        found = []
        for k in range(len(seen)):
            total, freedom = consistency([*seen[:k], *seen[k + 1 :]])
            agree = freedom > 0 and not contradicts((total, freedom), self._share)
            found.append((not agree, -freedom if agree else 0, total / max(freedom, 1), k))
        return min(found)[-1]

    def _follow(self, sensor: str, misfit: float) -> None:
        if np.isfinite(misfit):
            grown = self.noise(sensor) * (1.0 + _SMOOTH * (min(misfit, _SUDDEN) - 1.0))
            self._noise[sensor] = min(max(grown, 1.0), _LARGEST)

    def status(self, stamp: int, ignored: Mapping[str, int]) -> Diagnostics:
        """Returns a status for the whole and one for every sensor, and forgets the doubts that it reports."""
        text = "sensors contradict each other" if self._doubted else "sensors agree"
        rows: list[Row] = [
            ("fusion", text, Level.WARN if self._doubted else Level.OK, {k: str(n) for k, n in sorted(ignored.items())})
        ]
        for sensor in sorted(set(self._used) | set(self._doubted)):
            doubted = self._doubted[sensor]
            text, level = ("contradicts the others", Level.WARN) if doubted else ("used", Level.OK)
            noise = self.noise(sensor)
            if noise > 2.0 and not doubted:
                text, level = "covariance too small", Level.WARN
            values = {"used": str(self._used[sensor]), "doubted": str(doubted), "noise": f"{noise:.2f}"}
            rows.append((sensor, text, level, values))
        self._doubted.clear()
        return status_of_rows(stamp, rows)

    @property
    def doubted(self) -> bool:
        return bool(self._doubted)


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
