"""A cloud with what its sensors count: the fused estimate, or that of one modality."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.estimation.particles import wrapped
from operators.localization.competing_hypothesis import CompetingHypothesis
from operators.localization.observations import Observation
from operators.localization.particle_filter import DOUBTFUL, CloudConfig, ParticleFilter
from operators.localization.sensor_weights import SensorWeights

Array = NDArray[np.float64]
_WIDE, _TURNED, _MOST = 0.3, 0.15, 0.6
"""Localised: spread in m and rad below the first two, and more than the last of the weight in one place."""
_LOST = 0.25
"""Doubt above which the robot is lost."""
Word = Literal["waiting", "searching", "ambiguous", "localised", "lost"]
_APART = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A pose (3,) with covariance (3, 3), the share of the weight that it has, and whether it is to be believed.

    `other`: another place (3,) that explains what was observed about as well.
    """

    word: Word
    mean: Array
    covariance: Array
    share: float
    other: Array | None = None


def contradict(first: Estimate, second: Estimate) -> bool:
    """Returns whether two estimates, both to be believed, contradict each other."""
    if first.word != "localised" or second.word != "localised":
        return False
    off = first.mean - second.mean
    off[2:] = wrapped(off[2:])
    spread = first.covariance + second.covariance + np.diag([0.03**2, 0.03**2, 0.02**2])
    return float(off @ np.linalg.solve(spread, off)) > _APART


class WeightedCloud(Remembered):
    """A cloud that begins where the first observation puts it, and heeds sensors by their innovations."""

    sensor_weights: SensorWeights
    competing: CompetingHypothesis
    stamp: int
    _cloud: ParticleFilter | None

    def __init__(self, config: CloudConfig) -> None:
        self._config, self._cloud, self.stamp = config, None, -1
        self.sensor_weights, self.competing = SensorWeights(), CompetingHypothesis()

    def new_part(self, kind: type[Any]) -> ParticleFilter:
        return ParticleFilter(self._config, np.zeros((0, 3)))

    @property
    def begun(self) -> bool:
        return self._cloud is not None

    @property
    def injected(self) -> int:
        return 0 if self._cloud is None else self._cloud.injected

    def begin_at(self, pose: Array, sigma: tuple[float, float], rng: np.random.Generator) -> None:
        """Begins about a pose (3,); `sigma` in m and rad."""
        spread = np.array([sigma[0], sigma[0], sigma[1]])
        self._cloud = ParticleFilter(self._config, pose + spread * rng.standard_normal((self._config.most, 3)))
        self.competing.settle()

    def move(self, step: Array, covariance: Array, rng: np.random.Generator) -> None:
        if self._cloud is not None:
            self._cloud.move(step, covariance, rng)
            self.competing.move(step, covariance, rng)

    def update(self, sensor: str, stamp: int, observation: Observation, rng: np.random.Generator) -> None:
        """Takes an observation (its time in ns); one that is too weak to initialise the cloud is skipped."""
        self.stamp = stamp
        if self._cloud is None:
            self._cloud = ParticleFilter(self._config, observation.propose(self._config.most, rng))
            return
        mean, covariance, share = self._cloud.estimate()
        trust = self.sensor_weights.counts(stamp)
        if share > _MOST / 2:
            trust[sensor] = self.sensor_weights.update(sensor, stamp, observation.misfit(mean, covariance))
        evidence = self._cloud.weigh(sensor, observation, rng, trust)
        doubt = self._cloud.doubt(trust)
        if doubt > _LOST:
            self.competing.forget()
        elif self._narrow(covariance):
            counts = trust.get(sensor, 1.0)
            better = self.competing.update(mean, evidence, observation, counts, doubt > DOUBTFUL, rng)
            if better is not None:
                self._cloud.replace(better)

    def estimate(self) -> Estimate:
        """Returns where the robot is, and whether that is to be believed."""
        if self._cloud is None:
            return Estimate("waiting", np.zeros(3), np.eye(3) * 1e6, 0.0)
        mean, covariance, share = self._cloud.estimate()
        doubt = self._cloud.doubt(self.sensor_weights.counts(self.stamp))
        if doubt > _LOST:
            return Estimate("lost", mean, covariance, share)
        other = self.competing.mean
        if self._narrow(covariance) and other is not None:
            return Estimate("ambiguous", mean, covariance, share, other)
        found = self._narrow(covariance) and share > _MOST and self.competing.decided
        return Estimate("localised" if found else "searching", mean, covariance, share)

    @staticmethod
    def _narrow(covariance: Array) -> bool:
        return bool(np.trace(covariance[:2, :2]) < _WIDE**2 and covariance[2, 2] < _TURNED**2)

    def cloud(self) -> tuple[Array, Array]:
        """Returns poses (N, 3) and weights (N,)."""
        assert self._cloud is not None
        return self._cloud.poses, self._cloud.weights

    def figures(self) -> dict[str, str]:
        """Returns size and effective size of the cloud, as text."""
        if self._cloud is None:
            return {}
        return {"particles": str(len(self._cloud.poses)), "effective": f"{self._cloud.effective:.0f}"}

    def fits(self) -> dict[str, float]:
        """Returns how well each sensor fits lately, [0, 1]."""
        return {} if self._cloud is None else {sensor: fit.fast for sensor, fit in self._cloud.fits.items()}
