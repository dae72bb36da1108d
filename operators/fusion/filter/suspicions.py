"""Errors that sensors were not told to have, looked for in the innovations: late stamps, speeds of a wrong scale.

Beside the filter, which does not know of them, goes by how much each unit of such an error makes its estimate wrong.
Innovations are then white noise and a multiple of a known signature, whose size and significance follow. Friedland,
"Treatment of bias in recursive filtering", 1969; Willsky and Jones, "A generalized likelihood ratio approach to the
detection and estimation of jumps in linear systems", 1976.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import State
from operators.fusion.filter.measurements import FullPose, Model, Position, Velocity

Array = NDArray[np.float64]
LATE, SCALE = "late", "scale"
_SIGNIFICANT = 4.5
"""Standard deviations from which an error counts as found."""
_KEPT = 30.0
"""Seconds for which innovations count."""


def suspected(model: Model) -> str | None:
    """Returns which error is looked for in a kind of measurement, None for none."""
    if isinstance(model, Position | FullPose):
        return LATE
    speeds = isinstance(model, Velocity) and len(model.value) == 3 and model.value.any()
    return SCALE if speeds else None


@dataclass(frozen=True, eq=False)
class Suspicions:
    """Evidence (S,) of an error of each of `sensors`, of the kind in `kinds`, with the columns of a state's `effects`.

    `score`: signatures times whitened innovations, of which `information` is expected for each unit of the error and
    `variance` by chance; all fade until `time` (ns), that of the last measurement.
    """

    sensors: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    score: Array = field(default_factory=lambda: np.zeros(0))
    information: Array = field(default_factory=lambda: np.zeros(0))
    variance: Array = field(default_factory=lambda: np.zeros(0))
    time: int = 0

    def of(self, sensor: str, kind: str) -> Suspicions:
        """Returns these and one of a sensor, without evidence if it is new."""
        if sensor in self.sensors:
            return self
        score, information, variance = (np.append(one, 0.0) for one in (self.score, self.information, self.variance))
        return Suspicions((*self.sensors, sensor), (*self.kinds, kind), score, information, variance, self.time)

    def after(self, time: int, state: State, residual: Array, H: Array, noise: Array, signature: Array) -> Suspicions:
        """Returns these after the residual (M,) of a measurement, with what an error adds to it (M, S)."""
        left = math.exp(-max(time - self.time, 0) * 1e-9 / _KEPT) if self.time else 1.0
        G = signature - H @ state.effects
        white = np.linalg.solve(H @ state.covariance @ H.T + noise, G)
        told = np.einsum("ms,ms->s", G, white)
        return replace(
            self,
            score=left * self.score + residual @ white,
            information=left * self.information + told,
            variance=left**2 * self.variance + told,
            time=max(time, self.time),
        )

    @property
    def found(self) -> tuple[str, str, float, float] | None:
        """Returns sensor, kind, size and standard deviation (s, or a share) of the error that explains most, if any."""
        if not self.sensors:
            return None
        certain = np.abs(self.score) / np.sqrt(np.maximum(self.variance, 1e-300))
        k = int(np.argmax(certain))
        if certain[k] < _SIGNIFICANT:
            return None
        size = float(self.score[k] / self.information[k])
        return self.sensors[k], self.kinds[k], size, abs(size) / float(certain[k])
