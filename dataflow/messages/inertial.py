"""Inertial and magnetic measurements."""

from __future__ import annotations

from dataflow.messages.arrays import F64
from dataflow.messages.base import ANCHOR, Message, array, scalar
from dataflow.messages.checks import unit_quaternions


class Imu(Message):
    """One sample of an inertial measurement unit; REP 145's conventions."""

    frame: str = scalar("str", "frame of the sensor, in which the vectors are expressed", default=ANCHOR)
    temperature: float | None = scalar("float", "of the sensor, degrees Celsius", default=None)
    angular_velocity: F64 = array("float64", "3", "gyroscope reading", unit="rad/s")
    linear_acceleration: F64 = array(
        "float64", "3", "accelerometer reading: specific force, +9.81 upwards at rest", unit="m/s²"
    )
    orientation: F64 | None = array(
        "float64",
        "4",
        "quaternion (x, y, z, w) that maps the sensor's frame to east-north-up, if estimated",
        default=None,
    )
    angular_velocity_covariance: F64 | None = array("float64", "3 3", "of the gyroscope", unit="rad²/s²", default=None)
    linear_acceleration_covariance: F64 | None = array(
        "float64", "3 3", "of the accelerometer", unit="m²/s⁴", default=None
    )
    orientation_covariance: F64 | None = array(
        "float64", "3 3", "of rotation about the fixed x, y and z axes", unit="rad²", default=None
    )

    def validate(self) -> None:
        unit_quaternions(self, "orientation")


class MagneticField(Message):
    """One sample of a magnetometer."""

    frame: str = scalar("str", "frame of the sensor, in which the vector is expressed", default=ANCHOR)
    field: F64 = array("float64", "3", "magnetic flux density; NaN on an axis that is not measured", unit="T")
    covariance: F64 | None = array("float64", "3 3", "of the field", unit="T²", default=None)
