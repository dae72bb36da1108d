"""Constraints on a body's motion without a sensor of it: standstill, and no slip."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.fusion.filter.gate import GateConfig
from operators.fusion.filter.history import Sample
from operators.fusion.filter.measurements import AngularRate, Model, Velocity
from operators.fusion.sensors.settings import SensorSettings

Array = NDArray[np.float64]
_I3 = np.eye(3)
_SPAN, _PERIOD = 500_000_000, 100_000_000
"""ns: of the readings that show a standstill, and from one constraint to the next."""
_FEWEST = 10
"""Readings that show a standstill."""
_TURNS = 0.2
"""Angular rates at a standstill stray so many rad/s where forces stray one m/s²."""
_FASTEST = 0.1
"""rad/s: a mean above that is no gyroscope's bias."""
_STANDING, _NOT_TURNING = 0.005, 0.002
"""Standard deviations, m/s and rad/s, of a standstill."""


class Constraints(Remembered):
    """Makes measurements of what need not be measured, from inertial samples, ten times a second at most.

    *Standstill*: over half a second the readings stray less than a body that moves lets them. An inertial sensor alone
    does not distinguish rest from even motion, so this is for bodies that tremble as they move: hands, legs, rough
    ground; and the gate, which never yields, refuses it where the filter's state contradicts it. *Slip*: a rolling body
    moves neither aside nor upwards, up to a standard deviation.

    After Skog, Händel, Nilsson and Rantakokko, "Zero-velocity detection: an algorithm evaluation", 2010, and
    Dissanayake et al., "The aiding of a low-cost strapdown inertial measurement unit using vehicle model constraints",
    2001.
    """

    _kept: list[Sample]
    _last: int

    def __init__(self, standstill: float | None, slip: float | None) -> None:
        """`standstill`: RMS (m/s²) by which forces stray less at rest; `slip`: m/s. Neither is used where None."""
        self._standstill, self._slip = standstill, slip
        self._kept, self._last = [], -_PERIOD

    @property
    def gates(self) -> dict[str, GateConfig]:
        """The gates of what is made here, by the first word of its name."""
        names = [name for name, given in (("standstill", self._standstill), ("slip", self._slip)) if given is not None]
        return dict.fromkeys(names, SensorSettings().gate("range"))

    def after(self, sample: Sample, T_body_base: Array) -> Iterator[tuple[str, Model, Array]]:
        """Yields (name, model, covariance) of what holds at a sample; `T_body_base` (4, 4) places what rolls."""
        if self._standstill is not None:
            self._kept = [s for s in self._kept if sample.time - s.time <= _SPAN] + [sample]
        if sample.time - self._last < _PERIOD:
            return
        if self._stands():
            self._last = sample.time
            yield "standstill velocity", Velocity(np.zeros(3), _I3, np.zeros(3)), _I3 * _STANDING**2
            yield "standstill turning", AngularRate(np.zeros(3), _I3), _I3 * _NOT_TURNING**2
        elif self._slip is not None:
            self._last = sample.time
            aside = T_body_base[:3, 1:3].T
            yield "slip", Velocity(np.zeros(2), aside, T_body_base[:3, 3]), np.eye(2) * self._slip**2

    def _stands(self) -> bool:
        kept = self._kept
        if self._standstill is None or len(kept) < _FEWEST or kept[-1].time - kept[0].time < 0.8 * _SPAN:
            return False
        forces, rates = np.array([s.accel for s in kept]), np.array([s.gyro for s in kept])
        strays = float(np.sqrt(forces.var(axis=0).mean())), float(np.sqrt(rates.var(axis=0).mean()))
        steady = strays[0] < self._standstill and strays[1] < _TURNS * self._standstill
        return steady and float(np.linalg.norm(rates.mean(axis=0))) < _FASTEST
