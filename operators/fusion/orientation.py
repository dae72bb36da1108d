"""The orientation of an inertial sensor, by the package vqf on samples of any spacing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vqf import VQF

from dataflow.operator import Remembered

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OrientationConfig:
    """Time constants (s) by which accelerometer and magnetometer correct inclination and heading.

    `field_rate`: magnetic fields a second; that of the inertial samples if none.
    """

    tau_acc: float = 3.0
    tau_mag: float = 9.0
    field_rate: float | None = None


class Orientation(Remembered):
    """Takes samples with stamps (ns). vqf wants them equally spaced, so steps are divided into whole periods.

    A step of n periods is made of n samples on the straight line from the last reading to the new one; what it is
    longer or shorter than n periods scales their angular velocity, so that the angle turned is right.
    """

    stamp: int
    fields: int
    _period: float
    _last: tuple[Array, Array] | None
    _vqf_state: dict[str, Any]

    def __init__(self, config: OrientationConfig, period: float) -> None:
        """`period`: seconds between samples."""
        self._config, self._period = config, period
        self._last, self.stamp, self.fields, self._vqf_state = None, -1, 0, {}
        self.restored()

    def prepare_snapshot(self) -> None:
        self._vqf_state = self._vqf.state

    def restored(self) -> None:
        config, period = self._config, self._period
        field_period = period if config.field_rate is None else 1 / config.field_rate
        self._vqf = VQF(period, magTs=field_period, tauAcc=config.tau_acc, tauMag=config.tau_mag)
        kinds = self._vqf.state
        if self._vqf_state:
            self._vqf.state = {name: type(kinds[name])(_plain(value)) for name, value in self._vqf_state.items()}

    def feel(self, stamp: int, gyro: Array, accel: Array) -> None:
        """Takes angular velocity (rad/s) and specific force (m/s²); the stamp is later than the last."""
        if self._last is None:
            self._vqf.updateGyr(gyro)
            self._vqf.updateAcc(accel)
        else:
            span = (stamp - self.stamp) * 1e-9
            steps = max(1, round(span / self._period))
            scale = span / (steps * self._period)
            before_gyro, before_accel = self._last
            for k in range(1, steps + 1):
                share = k / steps
                self._vqf.updateGyr(np.ascontiguousarray((before_gyro + share * (gyro - before_gyro)) * scale))
                self._vqf.updateAcc(np.ascontiguousarray(before_accel + share * (accel - before_accel)))
        self._last, self.stamp = (np.array(gyro), np.array(accel)), stamp

    def see(self, field: Array) -> None:
        """Takes a magnetic field, of the stamp of the last sample and in any unit."""
        self._vqf.updateMag(np.array(field))
        self.fields += 1

    def orientation(self, *, magnetic: bool) -> Array:
        """The quaternion (x, y, z, w) that maps the sensor to east-north-up; if not magnetic, with any heading."""
        q = self._vqf.getQuat9D() if magnetic else self._vqf.getQuat6D()
        return np.roll(q, -1)

    @property
    def at_rest(self) -> bool:
        return bool(self._vqf.getRestDetected())

    @property
    def disturbed(self) -> bool:
        """The magnetic field is not that of the earth as known so far."""
        return bool(self._vqf.getMagDistDetected())


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
