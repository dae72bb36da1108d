"""Weights of sensors: each counts less, the larger its innovations are than usual."""

from __future__ import annotations

from dataclasses import dataclass

from dataflow.operator import Remembered

CONSISTENT, LARGEST = 3.0, 100.0
"""Squared innovations up to so many times the usual ones are consistent; none is taken for more than `LARGEST`."""
MEMORY = 1_500_000_000
"""Nanoseconds for which a sensor bears witness to others."""
_QUICK, _SLOW, _LEAST = 0.25, 0.03, 0.2


@dataclass(frozen=True)
class _Innovations:
    """Squared innovations over those explained by the noise: when heard (ns), of late, and usually (never above 1)."""

    stamp: int = 0
    lately: float = 1.0
    usual: float = 1.0

    @property
    def ratio(self) -> float:
        return self.lately / self.usual

    def after(self, stamp: int, misfit: float) -> _Innovations:
        lately = max(self.lately, 1e-3) ** (1 - _QUICK) * max(misfit, _LEAST) ** _QUICK
        usual = self.usual
        if misfit <= CONSISTENT * usual:
            usual = min(1.0, max(_LEAST, usual ** (1 - _SLOW) * max(misfit, _LEAST) ** _SLOW))
        return _Innovations(stamp, min(lately, LARGEST), usual)


class SensorWeights(Remembered):
    """Down-weights sensors whose normalised innovations are large, where another sensor is consistent.

    Where no sensor is consistent it is the pose that is wrong, and all count in full. Innovation-based adaptation:
    Mehra, "On the identification of variances and adaptive Kalman filtering", 1970.
    """

    _heard: dict[str, _Innovations]

    def __init__(self) -> None:
        self._heard = {}

    def update(self, sensor: str, stamp: int, misfit: float) -> float:
        """Takes the squared innovation over the one explained; returns what the sensor counts now, (0, 1]."""
        known = self._heard.get(sensor, _Innovations())
        now = min(misfit, LARGEST) / known.usual
        self._heard[sensor] = known.after(stamp, misfit)
        return self._count(sensor, stamp, max(now, self.ratio(sensor)))

    def ratio(self, sensor: str) -> float:
        """Returns how many times larger than usual squared innovations are of late."""
        return self._heard.get(sensor, _Innovations()).ratio

    def counts(self, stamp: int) -> dict[str, float]:
        """Returns what every sensor counts, (0, 1]."""
        return {sensor: self._count(sensor, stamp, heard.ratio) for sensor, heard in self._heard.items()}

    def _count(self, sensor: str, stamp: int, ratio: float) -> float:
        agreed = any(
            other.ratio <= CONSISTENT and stamp - other.stamp <= MEMORY
            for name, other in self._heard.items()
            if name != sensor
        )
        return 1.0 / ratio if ratio > CONSISTENT and agreed else 1.0
