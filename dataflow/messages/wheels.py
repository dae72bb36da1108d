"""Wheel encoders and joints."""

from __future__ import annotations

from dataflow.messages.arrays import F64, I64
from dataflow.messages.base import Message, array, scalar
from dataflow.messages.checks import parallel, unique


class WheelTicks(Message):
    """Encoder counts of the wheels."""

    names: tuple[str, ...] = scalar("strs", "name of each wheel's joint")
    ticks: I64 = array(
        "int64", "N", "count since power-on, signed, positive when rolling forwards, unwrapped", unit="ticks"
    )
    ticks_per_radian: F64 | None = array(
        "float64", "N", "encoder resolution at the wheel", unit="ticks/rad", default=None
    )
    radii: F64 | None = array("float64", "N", "wheel radius", unit="m", default=None)

    def validate(self) -> None:
        parallel(self, "names", len(self.ticks), "ticks")
        unique(self, "names")


class JointState(Message):
    """Positions, velocities and efforts of named joints; each is optional."""

    names: tuple[str, ...] = scalar("strs", "name of each joint")
    positions: F64 | None = array(
        "float64", "N", "angle, or length of a prismatic joint", unit="rad or m", default=None
    )
    velocities: F64 | None = array("float64", "N", "rate of the position", unit="rad/s or m/s", default=None)
    efforts: F64 | None = array("float64", "N", "torque, or force of a prismatic joint", unit="N·m or N", default=None)

    def validate(self) -> None:
        unique(self, "names")
        for name in ("positions", "velocities", "efforts"):
            values = self.__dict__[name]
            if values is not None:
                parallel(self, "names", len(values), name)
