"""Motions by several sensors are compared before anything averages them, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dataflow.messages import Diagnostics, Imu, Message, Odometry, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from dataflow.operator import Batch, Context, Counts, Duration, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.monitoring.motion_agreement import Array, Contradiction, Limits, MotionAgreement, Track, Window
from operators.status import counted_status

_NEWEST = 350_000_000  # ns: the speed from an older pose is not compared with the wheels'
_SLACK = 300_000_000  # ns that a window waits for the slowest sensor
_WHEELS = "wheels"
_HANGS = 500_000_000  # ns for which a sensor gives the same reading of a motion when it counts as hanging


@dataclass(kw_only=True)
class State(Counts):
    """Holds the sensors' tracks, what they were found to contradict, and which of them slip or hang."""

    agreement: MotionAgreement
    tracks: dict[str, Track] = field(default_factory=dict)
    blind: set[str] = field(default_factory=set)
    """Sensors that measure turns alone."""
    found: list[Contradiction] = field(default_factory=list)
    end: int = 0
    slipping: bool = False
    said: bool = False
    slipped: int = -1
    """When the wheels last slipped: a window with that time is no evidence on their radii."""
    readings: dict[str, tuple[int, Array]] = field(default_factory=dict)
    """Since when each of the moving sensors gives the reading that it gives."""
    hanging: set[str] = field(default_factory=set)


class MotionCheck(Operator, merge=True):
    """Compares the robot's motion by wheels, odometries and gyroscopes, and holds wheels back that are contradicted.

    Window by window each two sensors are compared: their ways, their turns, and the directions of both on the robot.
    A difference above a limit and its noise is reported, with the sensor that the others contradict; of two it is
    undecidable which is wrong. This reveals a camera whose depths are too long, wheels of another radius, a gyroscope
    of another scale, a sensor that is turned against its extrinsic, and one that repeats a reading of motion. Wheels
    are passed on at `checked` unless two others that agree contradict them, over many windows or at once (wheels that
    slip or send nothing).
    """

    wheels: In[Odometry] = In(doc="odometry of the wheels, with velocities")
    motions: In[Odometry] = In(many=True, doc="odometries of cameras and LiDARs, poses of their sensors")
    imu: Batch[Imu] = Batch(many=True, doc="angular velocities")
    extrinsics: Sampled[Transforms] = Sampled(doc="where the sensors are on the robot")
    checked: Out[Odometry] = Out(doc="the wheels' odometry, as long as it is not contradicted")
    status: Out[Diagnostics] = Out(doc="after every window, and when wheels are first held back")

    base_frame: str = Param("base_link", min_length=1, doc="frame of the robot's base, which the wheels move")
    window: Duration = Param("600ms", gt=0, doc="time over which motions are compared")
    way: float = Param(0.03, gt=0, doc="share by which ways may differ")
    turn: float = Param(0.03, gt=0, doc="share by which turns may differ")
    coarse_turn: float = Param(0.15, gt=0, doc="the same for the wheels', which depend on radii and slip")
    angle: float = Param(1.5, gt=0, doc="angle between directions", unit="°")
    slip: float = Param(0.15, gt=0, doc="speed by which wheels may differ at any moment, beside a third", unit="m/s")

    state: State

    def initial_state(self) -> State:
        limits = Limits(self.way, self.turn, self.coarse_turn, float(np.deg2rad(self.angle)))
        return State(agreement=MotionAgreement(limits))

    def process(
        self,
        context: Context,
        wheels: Odometry | None,
        motions: Mapping[str, Odometry],
        imu: tuple[Imu, ...],
        extrinsics: Transforms,
    ) -> Mapping[str, Message]:
        """Raises ValueError where the extrinsics do not hold a sensor."""
        turns = {
            frame: transform_between(extrinsics, frame, self.base_frame)[:3, :3] for frame in {s.frame for s in imu}
        }
        for sample in imu:
            name = f"gyroscope of {sample.frame}"
            self.state.blind.add(name)
            if not np.isfinite(sample.angular_velocity).all():
                self.state.counts[f"{name}: not finite"] += 1
                continue
            rate = turns[sample.frame] @ sample.angular_velocity
            self._follow(name, sample.stamp, sample.angular_velocity)
            self._track(name).twist(sample.stamp, np.concatenate([np.zeros(3), rate]))
        for stream, odometry in (motions or {}).items():
            T = transform_between(extrinsics, odometry.child_frame, self.base_frame)
            if not (np.isfinite(odometry.position).all() and np.isfinite(odometry.orientation).all()):
                self.state.counts[f"{stream.partition('/')[2]}: not finite"] += 1
                continue
            self._track(stream.partition("/")[2]).pose(odometry.stamp, T @ odometry.matrix() @ invert(T))
        messages: dict[str, Message] = {}
        if wheels is not None:
            messages |= self._passed(wheels)
        if self._judge(context.stamp) or self.state.said != self.state.slipping:
            messages["status"] = self._status(context.stamp)
        return messages

    def _track(self, name: str) -> Track:
        return self.state.tracks.setdefault(name, Track())

    def _passed(self, wheels: Odometry) -> dict[str, Message]:
        """The wheels' message if nothing contradicts it."""
        if wheels.linear is None or wheels.angular is None:
            return {"checked": wheels}
        if not all(np.isfinite(part).all() for part in (wheels.position, wheels.linear, wheels.angular)):
            self.state.counts["wheels: not finite"] += 1
            self.state.counts["held back"] += 1
            return {}
        self._track(_WHEELS).twist(wheels.stamp, np.concatenate([wheels.linear, wheels.angular]))
        self._follow(_WHEELS, wheels.stamp, np.concatenate([wheels.linear, wheels.angular]))
        self.state.slipping = self._slips(wheels)
        self.state.slipped = wheels.stamp if self.state.slipping else self.state.slipped
        held = self.state.slipping or any(c.alone and c.sensor == _WHEELS for c in self.state.found)
        self.state.counts["held back" if held else "passed on"] += 1
        return {} if held else {"checked": wheels}

    def _follow(self, name: str, stamp: int, reading: np.ndarray) -> None:
        """Notices a sensor that gives the same reading over and over, unless it is that of rest."""
        since, last = self.state.readings.get(name, (stamp, reading))
        same = bool(np.array_equal(reading, last))
        self.state.readings[name] = (since if same else stamp, reading)
        hangs = same and stamp - since >= _HANGS and bool(reading.any())
        (self.state.hanging.add if hangs else self.state.hanging.discard)(name)

    def _slips(self, wheels: Odometry) -> bool:
        """Returns whether two others that agree, or more, contradict the speed of the wheels."""
        assert wheels.linear is not None
        own = float(wheels.linear[0])
        others = []
        for name, track in sorted(self.state.tracks.items()):
            if name != _WHEELS and name not in self.state.blind:
                velocity = track.newest(wheels.stamp, _NEWEST)
                if velocity is not None:
                    others.append(float(velocity[0]))
        if len(others) < 2:
            return False
        allowed = self.slip + max(abs(v) for v in others) / 3
        return max(others) - min(others) < self.slip and all(abs(v - own) > allowed for v in others)

    def _judge(self, now: int) -> bool:
        """Takes the next window if it is past; False where it is not."""
        self.state.end = self.state.end or now + self.window
        if now < self.state.end + _SLACK:
            return False
        windows = {}
        for name, track in self.state.tracks.items():
            motion = track.between(self.state.end - self.window, self.state.end)
            if motion is not None and not (name == _WHEELS and self.state.slipped >= self.state.end - self.window):
                blind = np.where(np.arange(6) < 3, np.nan, motion) if name in self.state.blind else motion
                windows[name] = Window(blind, coarse=name == _WHEELS)
        self.state.agreement.add(windows)
        self.state.found = self.state.agreement.contradictions()
        self.state.counts["windows"] += 1
        self.state.counts["windows with a contradiction"] += bool(self.state.found)
        self.state.end = max(self.state.end + self.window, now - _SLACK)
        return True

    def _status(self, stamp: int) -> Diagnostics:
        self.state.said = self.state.slipping
        texts = [contradiction.text() for contradiction in self.state.found]
        if self.state.slipping:
            texts.insert(0, "the wheels turn otherwise than the robot moves")
        texts += [f"{name} repeats its last reading" for name in sorted(self.state.hanging)]
        text = "; ".join(texts) or "motions agree"
        return counted_status("motion_check", stamp, text, Level.WARN if texts else Level.OK, self.state.counts)
