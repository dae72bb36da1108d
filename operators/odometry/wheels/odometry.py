"""Odometry of a robot with two driven sides, from its wheels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, JointState, Odometry, WheelTicks
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import quaternion_from_yaw
from dataflow.operator import KEPT, Counts, Duration, In, Operator, Out, Param
from operators.geometry.planar import spatial
from operators.odometry.wheels.differential_drive import DifferentialDrive, DriveNoise
from operators.status import counted_status

Array = NDArray[np.float64]
UNREADABLE = "unreadable"
_FLAT = 1e-6  # variance of height, roll and pitch: the floor is taken as flat


@dataclass(frozen=True, eq=False)
class Reading:
    """Left and right (2,): `rolled` in metres since power-on, or `speed` in m/s; `step` is one count, metres."""

    rolled: Array | None = None
    speed: Array | None = None
    step: float = 0.0

    @property
    def finite(self) -> bool:
        return all(value is None or bool(np.isfinite(value).all()) for value in (self.rolled, self.speed))


def reading(
    message: WheelTicks | JointState, sides: tuple[Sequence[str], Sequence[str]], radius: float | None,
    ticks_per_turn: float | None,
) -> Reading:  # fmt: skip
    """Returns a message's reading of both sides, each the mean of its wheels.

    The message's own radii and resolution go before `radius` (metres) and `ticks_per_turn`. Raises ValueError where a
    wheel or one of them is missing.
    """
    missing = [name for side in sides for name in side if name not in message.names]
    if missing:
        raise ValueError(f"no wheel {missing[0]!r}; there are {', '.join(message.names) or 'none'}")
    places = [[message.names.index(name) for name in side] for side in sides]
    if isinstance(message, WheelTicks):
        radii = _each(message.radii, radius, "radius", len(message.names))
        turn = None if ticks_per_turn is None else ticks_per_turn / (2 * np.pi)
        scale = radii / _each(message.ticks_per_radian, turn, "ticks_per_turn", len(message.names))
        step = float(max(scale[place] for side in places for place in side))
        return Reading(rolled=_sides(message.ticks * scale, places), step=step)
    radii = _each(None, radius, "radius", len(message.names))
    if message.positions is not None:
        return Reading(rolled=_sides(message.positions * radii, places))
    if message.velocities is not None:
        return Reading(speed=_sides(message.velocities * radii, places))
    raise ValueError("the joints have neither positions nor velocities")


def _each(own: Array | None, given: float | None, name: str, count: int) -> Array:
    if own is not None:
        return own
    if given is None:
        raise ValueError(f"the message lacks the wheels' {name}: set the parameter {name}")
    return np.full(count, given)


def _sides(values: Array, places: list[list[int]]) -> Array:
    return np.array([values[side].mean() for side in places])


@dataclass(kw_only=True)
class State(Counts):
    """Holds the pose so far, which a reset of the clock leaves, and the last reading: the next is a first one then."""

    drive: DifferentialDrive = field(metadata=KEPT)
    stamp: int | None = None
    last: Reading | None = None
    speed: Array | None = None  # of left and right, m/s; None until there are two readings
    step: tuple[Array, float, float] = field(default_factory=lambda: (np.zeros(2), 1.0, 0.0))  # rolled, s, doubt


class WheelOdometry(Operator):
    """Dead-reckons a differential drive from encoder counts, wheel angles or wheel speeds; it starts at the origin.

    Between two readings the wheels are taken to roll evenly, so the robot drives an arc. The covariance holds slip,
    which is fresh with every metre, and errors of radii and track, which last. Wheels that speed up faster than the
    robot can slip: what they turned is doubted by the excess. Counts that no robot can have driven (a controller that
    began anew) are left out, and the motion so far goes on, doubted as far as it went. After a gap the shape of the way
    is unknown. A reading that is not finite gives no pose. Each is named and counted.

    Method: Siegwart, Nourbakhsh and Scaramuzza, "Introduction to Autonomous Mobile Robots", 2011, section 5.2.4; errors
    that last as in Borenstein and Feng, "Measurement and correction of systematic odometry errors in mobile robots",
    1996.
    """

    wheels: In[WheelTicks | JointState] = In(doc="encoder counts; or joints with positions, else velocities")
    odometry: Out[Odometry] = Out(
        doc="the robot in the odometry frame, with velocity and covariances; at every finite reading"
    )
    status: Out[Diagnostics] = Out(
        doc="rolling, standing, slipping, jumped, after a gap or unreadable; at every reading"
    )

    odometry_frame: str = Param("wheel_odom", min_length=1, doc="name of the frame that the first pose defines")
    base_frame: str = Param("base_link", min_length=1, doc="frame of the robot: between the wheels, x forward")
    left: tuple[str, ...] = Param(("left",), min_length=1, doc="wheels on the left; the mean of several counts")
    right: tuple[str, ...] = Param(("right",), min_length=1, doc="wheels on the right")
    track: float = Param(gt=0, doc="distance between left and right wheels", unit="m")
    radius: float | None = Param(None, gt=0, doc="of the wheels, where messages lack it", unit="m")
    ticks_per_turn: float | None = Param(None, gt=0, doc="counts a turn of a wheel, where messages lack it")
    slip: float = Param(
        0.006, ge=0, doc="standard deviation of a wheel's way after 1 m; grows with its root", unit="m/√m"
    )
    scale_error: float = Param(0.01, ge=0, lt=1, doc="standard deviation of the share by which a radius is off")
    track_error: float = Param(0.01, ge=0, lt=1, doc="and of that by which the track is off")
    max_speed: float = Param(5.0, gt=0, doc="faster wheels are a jump of the counts", unit="m/s")
    max_acceleration: float = Param(5.0, gt=0, doc="wheels that speed up faster slip", unit="m/s²")
    gap: Duration = Param("500ms", gt=0, doc="readings farther apart leave the way between unknown")

    state: State

    def setup(self) -> None:
        """Raises ValueError where a wheel is on both sides."""
        both = set(self.left) & set(self.right)
        if both:
            raise ValueError(f"wheel {min(both)!r} is on both sides")

    def initial_state(self) -> State:
        noise = DriveNoise(self.slip, self.scale_error, self.track_error)
        return State(drive=DifferentialDrive(self.track, noise))

    def process(self, wheels: WheelTicks | JointState) -> dict[str, Any]:
        """Raises ValueError where a wheel is missing, or its radius or resolution is unspecified."""
        now = reading(wheels, (self.left, self.right), self.radius, self.ticks_per_turn)
        state, level, text = self._move(self.state.drive, wheels.stamp, now)
        self.state.counts[state] += 1
        status = counted_status("wheel_odometry", wheels.stamp, f"{state}: {text}", level, self.state.counts)
        if state == UNREADABLE:
            return {"status": status}
        return {"odometry": self._odometry(self.state.drive, wheels.stamp), "status": status}

    def summary(self) -> Mapping[str, float | int]:
        return {f"readings {state}": count for state, count in self.state.counts.items()}

    def _move(self, drive: DifferentialDrive, stamp: int, now: Reading) -> tuple[str, Level, str]:
        """Takes in a reading; returns its state, how bad that is, and a text."""
        if not now.finite:
            return UNREADABLE, Level.WARN, "the reading is not finite"
        if self.state.stamp is None:
            self.state.stamp, self.state.last, self.state.speed = stamp, now, now.speed
            drive.step = now.step
            return "standing", Level.OK, "the first reading is the origin"
        seconds = (stamp - self.state.stamp) * 1e-9
        rolled, speed = self._rolled(now, seconds)
        self.state.stamp, self.state.last = stamp, now
        fastest = float(np.abs(rolled).max()) / seconds
        if fastest > self.max_speed:
            self._coast(drive, seconds)
            return "jumped", Level.WARN, f"wheels turned at {fastest:.1f} m/s: left out, the motion so far goes on"
        excess = self._excess(speed, seconds, now.step)
        slipping = excess > 0 and seconds <= self.gap * 1e-9
        doubt = excess * seconds if slipping else 0.0
        drive.roll(float(rolled[0]), float(rolled[1]), doubt)
        self.state.speed, self.state.step = speed, (rolled, seconds, doubt)
        if seconds > self.gap * 1e-9:
            drive.wander(float(np.abs(rolled).mean()) / 2)
            return "after a gap", Level.WARN, f"nothing was heard for {seconds:.2f} s"
        if slipping:
            return "slipping", Level.WARN, f"a wheel's speed changed by {excess:.2f} m/s more than it can"
        if not rolled.any():
            return "standing", Level.OK, "no wheel turned"
        return "rolling", Level.OK, f"{float(speed.mean()):.2f} m/s"

    def _rolled(self, now: Reading, seconds: float) -> tuple[Array, Array]:
        """Metres that each side rolled since the last reading, and its speed now as far as it is known."""
        if now.rolled is not None and self.state.last is not None and self.state.last.rolled is not None:
            rolled = now.rolled - self.state.last.rolled
            return rolled, rolled / seconds
        assert now.speed is not None
        before = now.speed if self.state.speed is None else self.state.speed
        return (before + now.speed) / 2 * seconds, now.speed

    def _excess(self, speed: Array, seconds: float, step: float) -> float:
        """Returns by how much a wheel's speed changed more than the robot can, in m/s; a count more or less is none."""
        if self.state.speed is None:
            return 0.0
        return float(np.abs(speed - self.state.speed).max()) - self.max_acceleration * seconds - 2 * step / seconds

    def _coast(self, drive: DifferentialDrive, seconds: float) -> None:
        """Goes on as before, in doubt of all of it and of a start from rest."""
        rolled = np.zeros(2) if self.state.speed is None else self.state.speed * seconds
        doubt = float(np.abs(rolled).max()) + 0.5 * self.max_acceleration * min(seconds, 1.0) ** 2
        drive.roll(float(rolled[0]), float(rolled[1]), doubt)
        self.state.step = (rolled, seconds, doubt)

    def _odometry(self, drive: DifferentialDrive, stamp: int) -> Odometry:
        rolled, seconds, doubt = self.state.step
        x, y, yaw = drive.pose
        left, right = rolled / seconds
        return Odometry(
            stamp=stamp,
            frame=self.odometry_frame,
            child_frame=self.base_frame,
            position=np.array([x, y, 0.0]),
            orientation=quaternion_from_yaw(yaw),
            pose_covariance=spatial(drive.covariance(), rest=_FLAT),
            linear=np.array([(left + right) / 2, 0.0, 0.0]),
            angular=np.array([0.0, 0.0, (right - left) / self.track]),
            twist_covariance=spatial(
                drive.twist_covariance(float(rolled[0]), float(rolled[1]), seconds, doubt), (0, 5), _FLAT
            ),
        )
