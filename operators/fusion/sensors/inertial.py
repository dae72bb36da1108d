"""Takes the messages of the inertial sensor: samples with their noise, and the first estimate of the first of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Imu
from dataflow.operator import Remembered
from operators.fusion.filter.error_state import Noise
from operators.fusion.filter.gate import threshold
from operators.fusion.filter.history import Node, Sample
from operators.fusion.filter.initialisation import Prior, first_node, rests
from operators.fusion.filter.measurements import FullPose, Model, Position, Velocity
from operators.fusion.sensors.covariances import UnusableMessage

Array = NDArray[np.float64]
_LONGEST = 0.1
"""Seconds to the last sample above which that time does not count as the sensor's period."""

_MOVES = 0.9999
"""Share of what chance does to a measurement of a body at rest, above which it shows that the body moves."""


@dataclass(frozen=True)
class InertialConfig:
    """Densities of noise (rad/s/√Hz, m/s²/√Hz), of the messages' covariances where None; random walks of the biases.

    The filter begins after `rest` seconds at rest, or `patience` seconds in motion.
    """

    gyro_noise: float | None
    accel_noise: float | None
    gyro_walk: float
    accel_walk: float
    rest: float
    patience: float


class InertialSensor(Remembered):
    """Makes samples of messages, and keeps those of the beginning."""

    _kept: list[Sample]
    _first: int
    _last: int
    _noise: Noise | None
    _places: dict[str, tuple[int, Array, Array]]
    _moved: int

    def __init__(self, config: InertialConfig) -> None:
        self._config = config
        self._kept, self._first, self._last, self._noise = [], -1, -1, None
        self._places, self._moved = {}, -1

    def sample(self, name: str, imu: Imu, time: int) -> Sample:
        """Returns the sample of a message that was measured at a time (ns).

        Raises UnusableMessage for readings that are not finite or all zero (a sensor that is off: at rest there is
        gravity, in free fall there is noise), and for a sample not later than the last, ValueError where the noise of
        the samples is unspecified.
        """
        if not (np.isfinite(imu.angular_velocity).all() and np.isfinite(imu.linear_acceleration).all()):
            raise UnusableMessage("not finite")
        if not (imu.angular_velocity.any() or imu.linear_acceleration.any()):
            raise UnusableMessage("all zero")
        if time <= self._last:
            raise UnusableMessage("stamp not later than the last")
        noise = self._noise_of(name, imu, time)
        if self._first < 0:
            self._first = time
        self._last, self._noise = time, noise
        return Sample(time, imu.angular_velocity, imu.linear_acceleration, noise)

    def saw(self, time: int, sensor: str, model: Model, noise: Array) -> None:
        """Takes a measurement from before the first estimate: a body that drives straight on feels like one at rest."""
        if isinstance(model, Velocity) and len(model.value) == 3:  # one beam of a radar may see what moves
            off = model.value
        elif isinstance(model, Position | FullPose):
            value = model.value if isinstance(model, Position) else model.place
            known = np.isfinite(value)
            noise = noise[: known.sum(), : known.sum()]
            first = self._places.get(sensor)
            if (
                first is None
                or not 0 <= time - first[0] <= self._config.rest * 1e9
                or (np.isfinite(first[1]) != known).any()
            ):
                self._places[sensor] = time, value, noise
                return
            _, place, spread = first
            off, noise = (value - place)[known], noise + spread
        else:
            return
        if off @ np.linalg.solve(noise, off) > threshold(_MOVES, len(off)):
            self._moved = max(self._moved, time)

    def begun(self, sample: Sample, prior: Prior, gravity: float, T_body_base: Array) -> tuple[Node, bool] | None:
        """Returns the first estimate, and whether it was made at rest, once the samples suffice."""
        config = self._config
        self._kept = [s for s in self._kept if sample.time - s.time <= config.rest * 1e9] + [sample]
        waited = (sample.time - self._first) * 1e-9
        if waited < config.rest or len(self._kept) < 3:
            return None
        resting = rests(self._kept, prior) and self._moved < self._kept[0].time
        if not resting and waited < config.patience:
            return None
        node = first_node(self._kept, prior, gravity, at_rest=resting, T_body_base=T_body_base)
        self._kept = []
        return node, resting

    def _noise_of(self, name: str, imu: Imu, time: int) -> Noise:
        """Densities of the configuration, else of the message's covariance and the time since the last."""
        period = min((time - self._last) * 1e-9, _LONGEST) if self._last >= 0 else 0.01
        found = []
        for given, covariance, known, word in (
            (self._config.gyro_noise, imu.angular_velocity_covariance, "gyro", "gyro_noise"),
            (self._config.accel_noise, imu.linear_acceleration_covariance, "accel", "accel_noise"),
        ):
            variance = math.nan if covariance is None else float(covariance.diagonal().max())
            if given is not None:
                found.append(given)
            elif math.isfinite(variance) and variance > 0:
                found.append(math.sqrt(variance * period))
            elif self._noise is not None:  # one message without: as good as the last
                found.append(float(getattr(self._noise, known)))
            else:
                raise ValueError(
                    f"{name}: its samples have no covariance above 0, so {word} must say how good they are"
                )
        return Noise(found[0], found[1], self._config.gyro_walk, self._config.accel_walk)
