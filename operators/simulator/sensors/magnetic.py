"""A magnetometer in the Earth's field and that of a building's iron."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import MagneticField
from operators.simulator.sensors.frames import Array, place
from operators.simulator.settings import Magnetometer
from operators.simulator.stage import Stage

_WAVES = 8
_WAVELENGTHS = (1.5, 8.0)  # metres


def earth_field(sensor: Magnetometer) -> Array:
    """Flux density (3,) in the world, whose x axis points east, T."""
    dip, turn = sensor.inclination, sensor.declination
    level = np.cos(dip)
    return np.asarray(sensor.strength * np.array([level * np.sin(turn), level * np.cos(turn), -np.sin(dip)]))


class MagneticModel:
    """The sensor in a building whose iron bends the field, smoothly from place to place."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 51])
        length = np.exp(rng.uniform(math.log(_WAVELENGTHS[0]), math.log(_WAVELENGTHS[1]), (3, _WAVES)))
        heading = rng.uniform(0, 2 * np.pi, (3, _WAVES))
        self._pulse = 2 * np.pi / length * np.array([np.cos(heading), np.sin(heading)])  # (2, 3, waves)
        self._phase = rng.uniform(0, 2 * np.pi, (3, _WAVES))

    def bend(self, position: Array) -> Array:
        """The building's field (3,) of unit deviation at a place (3,)."""
        angle = self._pulse[0] * position[0] + self._pulse[1] * position[1] + self._phase
        return np.asarray(np.sqrt(2 / _WAVES) * np.sin(angle).sum(axis=1))

    def measure(
        self, stage: Stage, sensor: Magnetometer, t: float, rng: np.random.Generator, stamp: int, frame: str
    ) -> MagneticField:
        T = stage.T_world_base(t) @ place(sensor)
        field = T[:3, :3].T @ (earth_field(sensor) + sensor.disturbance * self.bend(T[:3, 3]))
        field = field * [1 + sensor.soft_iron, 1, 1] + np.array(sensor.hard_iron)
        return MagneticField(
            stamp=stamp,
            frame=frame,
            field=field + sensor.noise * rng.standard_normal(3),
            covariance=np.eye(3) * max(sensor.noise, 1e-9) ** 2,
        )
