"""The orientation of an inertial sensor as an operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from vqf import VQF

from dataflow.messages import Diagnostics, Imu, MagneticField
from dataflow.operator import KEPT, In, Operator, Out, Param, Remembered, Sampled

Array = NDArray[np.float64]
_WARM_UP = 16


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

    def __init__(
        self, period: float, tau_acc: float = 3.0, tau_mag: float = 9.0, field_rate: float | None = None
    ) -> None:
        """`period`: seconds between samples; the rest as the operator's parameters."""
        self._period, self._taus, self._field_rate = period, (tau_acc, tau_mag), field_rate
        self._last, self.stamp, self.fields, self._vqf_state = None, -1, 0, {}
        self.restored()

    def prepare_snapshot(self) -> None:
        self._vqf_state = self._vqf.state

    def restored(self) -> None:
        field_period = self._period if self._field_rate is None else 1 / self._field_rate
        self._vqf = VQF(self._period, magTs=field_period, tauAcc=self._taus[0], tauMag=self._taus[1])
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


@dataclass
class State:
    """Holds the filter, and the first samples (stamp, rad/s, m/s²) until it is made."""

    filter: Orientation | None = None
    waiting: list[tuple[int, Array, Array]] = field(default_factory=list)
    last_field: int = -1
    last_stamp: int = -1
    word: str = ""
    ignored: Counter[str] = field(default_factory=Counter, metadata=KEPT)
    samples: int = field(default=0, metadata=KEPT)
    rested: int = field(default=0, metadata=KEPT)


class OrientationFilter(Operator):
    """Estimates the orientation of an inertial sensor from its gyroscope, accelerometer and magnetometer.

    With a magnetic field (9-D) the orientation maps the sensor to magnetic east-north-up, and fields that do not look
    like the earth's are rejected for a while; without one (6-D) the heading begins at 0 and drifts. The gyroscope's
    bias is estimated at rest and in motion. The output begins when the rate of the samples is known, after 16 of them.
    Missing samples are bridged up to `max_gap`, with the readings in a straight line; after a longer gap the filter
    begins anew.

    Method: Laidig and Seel, "VQF: highly accurate IMU orientation estimation with bias estimation and magnetic
    disturbance rejection", 2023; by the package vqf.
    """

    imu: In[Imu] = In(doc="angular velocity and specific force")
    magnetic_field: Sampled[MagneticField] = Sampled(
        required=False, doc="in the same frame, at the rate of the inertial samples or less"
    )
    oriented: Out[Imu] = Out(doc="the samples with their orientation")
    status: Out[Diagnostics] = Out(doc="whether the sensor rests, the field is disturbed; at every change")

    heading: Literal["magnetic", "relative"] = Param(
        "magnetic", doc="magnetic uses the field where there is one; relative lets the heading begin at 0"
    )
    tau_acc: float = Param(3.0, gt=0, doc="time constant by which the accelerometer corrects the inclination", unit="s")
    tau_mag: float = Param(9.0, gt=0, doc="and the magnetometer the heading", unit="s")
    field_rate: float | None = Param(
        None, gt=0, doc="magnetic fields a second; the rate of the inertial samples if none", unit="Hz"
    )
    max_gap: float = Param(0.5, gt=0, doc="longest time without a sample that is bridged", unit="s")

    state: State

    def new_part(self, kind: type[Any]) -> Orientation:
        return self._made(1.0)  # it restores the period

    def process(self, imu: Imu, magnetic_field: MagneticField | None = None) -> dict[str, Any] | None:
        """Raises ValueError where the magnetic field is in another frame."""
        gyro, accel = imu.angular_velocity, imu.linear_acceleration
        if not (np.isfinite(gyro).all() and np.isfinite(accel).all()):
            self.state.ignored["sample not finite"] += 1
            return None
        if self.state.last_stamp >= 0 and imu.stamp - self.state.last_stamp > self.max_gap * 1e9:
            self.state.ignored["gap, begun anew"] += 1
            self.on_reset("imu")
        self.state.last_stamp = imu.stamp
        field = self._new_field(imu, magnetic_field)
        if self.state.filter is None and not self._warm(imu):
            return None
        assert self.state.filter is not None
        if imu.stamp > self.state.filter.stamp:
            self.state.filter.feel(imu.stamp, gyro, accel)
        if field is not None:
            self.state.filter.see(field)
        self.state.samples += 1
        self.state.rested += self.state.filter.at_rest
        q = self.state.filter.orientation(magnetic=self.heading == "magnetic")
        oriented = Imu(
            stamp=imu.stamp,
            frame=imu.frame,
            temperature=imu.temperature,
            angular_velocity=gyro,
            linear_acceleration=accel,
            orientation=q,
            angular_velocity_covariance=imu.angular_velocity_covariance,
            linear_acceleration_covariance=imu.linear_acceleration_covariance,
        )
        return {"oriented": oriented, "status": self._status(imu.stamp)}

    def summary(self) -> Mapping[str, float | int | str]:
        figures: dict[str, float | int | str] = {"samples": self.state.samples, "at rest": self.state.rested}
        return figures | {f"ignored, {reason}": count for reason, count in sorted(self.state.ignored.items())}

    def _made(self, period: float) -> Orientation:
        return Orientation(period, self.tau_acc, self.tau_mag, self.field_rate)

    def _new_field(self, imu: Imu, field: MagneticField | None) -> np.ndarray | None:
        """The field (3,) where it is one that was not used before, and usable."""
        if field is None or self.heading == "relative" or field.stamp == self.state.last_field:
            return None
        if field.frame != imu.frame:
            raise ValueError(
                f"the magnetic field is in the frame {field.frame!r} but the inertial samples in {imu.frame!r}: the "
                "filter needs both in one"
            )
        self.state.last_field = field.stamp
        if not np.isfinite(field.field).all() or not field.field.any():
            self.state.ignored["field not finite or zero"] += 1
            return None
        return field.field

    def _warm(self, imu: Imu) -> bool:
        """Collects the first samples; makes the filter, and gives them to it, when their rate is known."""
        self.state.waiting.append((imu.stamp, imu.angular_velocity, imu.linear_acceleration))
        if len(self.state.waiting) < _WARM_UP:
            return False
        stamps = [stamp for stamp, _, _ in self.state.waiting]
        self.state.filter = self._made(float(np.median(np.diff(stamps))) * 1e-9)
        for stamp, gyro, accel in self.state.waiting:
            self.state.filter.feel(stamp, gyro, accel)
        self.state.waiting = []
        return True

    def _status(self, stamp: int) -> Diagnostics | None:
        """The status, where it differs from the last one that was given."""
        made = self.state.filter
        assert made is not None
        rest = "at rest" if made.at_rest else "in motion"
        if self.heading == "relative":
            field, level = "heading from the gyroscope alone, as asked", 0
        elif not made.fields:
            field, level = "no magnetic field: heading from the gyroscope alone", 1
        elif made.disturbed:
            field, level = "magnetic field disturbed: heading from the gyroscope meanwhile", 1
        else:
            field, level = "heading from the magnetic field", 0
        state = f"{rest}; {field}"
        if state == self.state.word:
            return None
        self.state.word = state
        return Diagnostics(
            stamp=stamp,
            names=("orientation",),
            messages=(state,),
            levels=np.array([level], np.uint8),
            keys=tuple(self.state.ignored),
            values=tuple(str(count) for count in self.state.ignored.values()),
            owners=np.zeros(len(self.state.ignored), np.int32) if self.state.ignored else None,
        )
