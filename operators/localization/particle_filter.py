"""Monte Carlo localisation: a cloud of poses that moves, is weighed by observations, and is drawn anew.

Samples that an observation would put elsewhere are mixed in when observations fit worse than they used to: augmented
Monte Carlo localisation with sensor resetting. Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, 8.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.estimation.particles import (
    bins_of,
    effective_size,
    evidence_of,
    mode,
    normalised,
    particles_needed,
    systematic,
)
from operators.localization.motion import moved
from operators.localization.observations import Observation

Array = NDArray[np.float64]
_TOLERATED = 0.75
"""Share of its usual fit below which a sensor's observations are worse than chance makes them."""
DOUBTFUL = 0.05
"""Loss of fit from which on poses are injected."""
_EXPLORED = 0.01
"""Share that is injected of a sensor that contradicts the others, and now and then of all: the pose may be wrong."""


@dataclass(frozen=True)
class CloudConfig:
    """The rules of a cloud.

    `least`, `most`: how many samples; between them as many as keep the error of the distribution below `error`, counted
    in bins of `size` (m) and `angle` (rad). It is drawn anew when fewer than the share `worn` of it is effective.
    `expected`: how well observations fit before any was seen, [0, 1]. Every `explore`th observation of a sensor injects
    a little though all is well. `largest`: share that is injected at most.
    """

    least: int = 200
    most: int = 1000
    error: float = 0.05
    size: float = 0.25
    angle: float = 0.175
    worn: float = 0.5
    expected: float = 0.6
    explore: int = 10
    largest: float = 0.5


@dataclass(frozen=True)
class SensorFit:
    """Fit of the observations of a sensor, [0, 1]: lately (`fast`) and usually (`slow`)."""

    fast: float
    slow: float

    def after(self, fit: float) -> SensorFit:
        fast = self.fast + 0.3 * (fit - self.fast)
        return SensorFit(fast, self.slow + (0.05 if fast > self.slow else 0.002) * (fast - self.slow))

    @property
    def loss(self) -> float:
        """Share of the usual fit that is missing, beyond what comes and goes."""
        return max(0.0, 1.0 - self.fast / max(_TOLERATED * self.slow, 1e-6))


class ParticleFilter(Remembered):
    """A cloud of poses (N, 3) with logarithms of their weights, and how well each sensor fits it."""

    poses: Array
    logarithms: Array
    fits: dict[str, SensorFit]
    injected: int
    _heard: dict[str, int]

    def __init__(self, config: CloudConfig, poses: Array) -> None:
        self.config, self.poses, self.logarithms = config, poses, np.zeros(len(poses))
        self.fits, self.injected, self._heard = {}, 0, {}

    @property
    def weights(self) -> Array:
        return normalised(self.logarithms)

    @property
    def effective(self) -> float:
        return effective_size(self.weights)

    def estimate(self) -> tuple[Array, Array, float]:
        """Returns mean (3,) and covariance (3, 3) of the heaviest place, and its share of the weight."""
        return mode(self.poses, self.weights, self.config.size, self.config.angle)

    def move(self, step: Array, covariance: Array, rng: np.random.Generator) -> None:
        """Moves by a step (3,) in the robot's frame, with noise."""
        self.poses = moved(self.poses, step, covariance, rng)

    def replace(self, poses: Array) -> None:
        """Takes poses (N, 3) in the place of the cloud."""
        self.poses, self.logarithms = poses, np.zeros(len(poses))

    def weigh(
        self, sensor: str, observation: Observation, rng: np.random.Generator, trust: Mapping[str, float] | None = None
    ) -> float:
        """Takes an observation; returns the logarithm of its likelihood in the cloud.

        `trust`: weight of each sensor, (0, 1]; 1 for sensors that it lacks.
        """
        trust = trust or {}
        logarithms, fits = observation.score(self.poses)
        logarithms = logarithms * trust.get(sensor, 1.0)
        evidence = evidence_of(self.weights, logarithms)
        self.logarithms += logarithms
        weights = self.weights
        before = self.fits.get(sensor, SensorFit(self.config.expected, self.config.expected))
        self.fits[sensor] = before.after(float(weights @ fits))
        doubt = self.doubt(trust)
        heard = self._heard[sensor] = self._heard.get(sensor, 0) + 1
        if trust.get(sensor, 1.0) < 0.5:  # an outvoted sensor proposes little: others judge it before it outweighs them
            self._draw(weights, rng, observation, _EXPLORED)
        elif doubt > DOUBTFUL:
            self._draw(weights, rng, observation, min(1.5 * doubt, self.config.largest))
        elif heard % self.config.explore == 0:
            self._draw(weights, rng, observation, _EXPLORED)
        elif effective_size(weights) < self.config.worn * len(weights):
            self._draw(weights, rng)
        return evidence

    def doubt(self, trust: Mapping[str, float]) -> float:
        """Returns how much worse than usual sensors fit of late, by what they count, [0, 1]."""
        counts = {sensor: trust.get(sensor, 1.0) for sensor in self.fits}
        lost = sum(count * self.fits[sensor].loss for sensor, count in counts.items())
        return lost / sum(counts.values()) if counts else 0.0

    def _draw(
        self, weights: Array, rng: np.random.Generator, observation: Observation | None = None, share: float = 0.0
    ) -> None:
        config = self.config
        drawn = systematic(weights, config.most, float(rng.random()))
        bins = len(np.unique(bins_of(self.poses[np.unique(drawn)], config.size, config.angle)))
        count = min(config.most, max(config.least, particles_needed(bins, config.error)))
        count = count if observation is None else config.most
        fresh = round(share * count)
        poses = self.poses[systematic(weights, count - fresh, float(rng.random()))]
        if observation is not None and fresh:
            self.injected += fresh
            poses = np.vstack([poses, observation.propose(fresh, rng)])
        self.replace(poses)
