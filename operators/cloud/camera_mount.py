"""Pose of a camera on its base, from what it sees, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Imu, Odometry, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, Duration, In, Operator, Out, Param, Sampled
from operators.cloud.vertical import Vertical, accelerated, find_vertical, held
from operators.geometry.extrinsics import transform_between, with_transform
from operators.status import counted_status

Array = NDArray[np.float64]

_WRONG = np.radians(10.0)  # between a given vertical and that of a view which decides; no such view is so far off


@dataclass
class State(Counts):
    """Holds the best view so far and what was decided by it: T_base_camera (4, 4), None where the base was given.

    `ground` is the best view that showed the ground, `first` the stamp since when a view is sought, `known` the digest
    of the extrinsics that were completed last. `given` (3,) is up in the cloud's frame by a given base that no view has
    been compared with yet, `finding` what was wrong with it.
    """

    done: bool = False
    first: int | None = None
    best: Vertical | None = None
    ground: Vertical | None = None
    T: Array | None = None
    known: bytes = b""
    figures: dict[str, float] = field(default_factory=dict)
    given: Array | None = None
    finding: str = ""


class CameraMount(Operator):
    """Completes the extrinsics of a camera by its base: a frame that is level, on the ground below, and looks ahead.

    The vertical comes from the level and upright surfaces of a view, and from the accelerometer where there is one; the
    ground is the lowest level surface, of that view or one before. The first view that shows the vertical without doubt
    decides, for the map's frame begins with it; after `patience` the best one so far does, with a warning. The base is
    level where the camera's odometry began. A camera on its side or upside down looks like one that is not where floor
    and walls are square: it needs an accelerometer, or a given base. Extrinsics that hold the base are passed on as
    they are; where the first view that shows the vertical without doubt is far off them, a warning and the finding at
    the run's end state it.

    Method: directions of surfaces as in Coughlan and Yuille, "Manhattan world", 1999.
    """

    cloud: In[PointCloud] = In(doc="points of a depth camera in its optical frame: x right, y down, z ahead")
    extrinsics: Sampled[Transforms] = Sampled(required=False, doc="transforms between the sensors")
    imu: Sampled[Imu] = Sampled(required=False, doc="an accelerometer that the extrinsics relate to the cloud's frame")
    motion: Sampled[Odometry] = Sampled(
        required=False, doc="the camera since its odometry began: a view that decides later counts from there"
    )
    base_extrinsics: Out[Transforms] = Out(doc="the extrinsics with the camera on its base, from when that is known")
    status: Out[Diagnostics] = Out(
        doc="how the camera looked at first, with standard deviations; a warning where that is a guess"
    )

    base_frame: str = Param("base_link", min_length=1, doc="frame of the base: x ahead, z up")
    patience: Duration = Param("2s", ge=0, doc="time after which a view decides that shows little")

    state: State

    def process(
        self,
        cloud: PointCloud,
        extrinsics: Transforms | None = None,
        imu: Imu | None = None,
        motion: Odometry | None = None,
    ) -> dict[str, Any] | None:
        """Raises ValueError where no extrinsics relate the accelerometer to the cloud."""
        if self.state.done and self.state.given is None:
            return self._again(cloud, extrinsics)
        self.state.first = cloud.stamp if self.state.first is None else self.state.first
        given = extrinsics is not None and self.base_frame in (*extrinsics.frames, *extrinsics.child_frames)
        if given and not self.state.done:
            self.state.done, self.state.known = True, _digest(extrinsics)
            self.state.given = transform_between(extrinsics, self.base_frame, cloud.frame)[:3, 2]
            made: dict[str, Any] = {"base_extrinsics": extrinsics}
        else:
            made = self._again(cloud, extrinsics) or {} if self.state.done else {}
        self.state.counts["views"] += 1
        expected, information = self._expected(cloud, extrinsics, imu)
        found = find_vertical(cloud.points, expected, information)
        if found is not None and motion is not None:
            found = found.before(motion.matrix()) if np.isfinite(motion.matrix()).all() else None
        patient = cloud.stamp - self.state.first < self.patience
        decides = found is not None and found.doubt <= 1
        if self.state.given is not None:
            return (made if patient and not decides else made | self._judged(cloud, found if decides else None)) or None
        if found is not None:
            self._compare(found)
        if patient and not decides:
            return None
        if self.state.best is None:
            self.state.best = Vertical(expected, np.asarray(np.linalg.inv(information), np.float64), 1.0, None)
        self.state.done = True
        return self._decided(cloud, extrinsics, self.state.best)

    def _judged(self, cloud: PointCloud, found: Vertical | None) -> dict[str, Any]:
        """Compares the given base with a view that decides; None where there was none."""
        given, self.state.given = self.state.given, None
        assert given is not None
        text = f"{self.base_frame} is given"
        if found is None:
            text += "; few surfaces show whether it is right"
        elif (off := float(np.arccos(np.clip(given @ found.up, -1, 1)))) > _WRONG:
            aside = min(abs(off - np.pi / 2), np.pi - off) < _WRONG  # walls and floor look alike then
            text = self.state.finding = (
                f"by the given {self.base_frame} the camera looks {_look(given)}, by the surfaces in sight "
                f"{_look(found.up)}: {'if it is not mounted on its side or upside down, ' if aside else ''}the "
                f"extrinsics are wrong; without {self.base_frame} in them it is found"
            )
        level = Level.WARN if self.state.finding else Level.OK
        return {"status": counted_status("camera_mount", cloud.stamp, text, level, {})}

    def _compare(self, found: Vertical) -> None:
        """Keeps a view that is better than those so far."""
        if self.state.best is None or found.doubt < self.state.best.doubt:
            self.state.best = found
        if found.height is not None and (self.state.ground is None or found.doubt < self.state.ground.doubt):
            self.state.ground = found

    def _expected(self, cloud: PointCloud, extrinsics: Transforms | None, imu: Imu | None) -> tuple[Array, Array]:
        """Returns where up is likely in the cloud's frame, with its information, before anything is seen."""
        if imu is None:
            return held()
        if extrinsics is None and imu.frame != cloud.frame:
            raise ValueError(f"imu is in frame {imu.frame!r} and cloud in {cloud.frame!r}: extrinsics must relate them")
        if not np.isfinite(imu.linear_acceleration).all():
            self.state.counts["accelerations_not_finite"] += 1
            return held()
        R = transform_between(extrinsics, imu.frame, cloud.frame)[:3, :3]
        return accelerated(R @ imu.linear_acceleration)

    def _again(self, cloud: PointCloud, extrinsics: Transforms | None) -> dict[str, Any] | None:
        """Returns the completed extrinsics where those between the sensors have changed since."""
        if extrinsics is None or _digest(extrinsics) == self.state.known:
            return None
        self.state.known = _digest(extrinsics)
        T = self.state.T
        completed = extrinsics
        if T is not None:
            completed = with_transform(extrinsics, cloud.stamp, self.base_frame, cloud.frame, T)
        return {"base_extrinsics": completed.replace(stamp=cloud.stamp)}

    def _decided(self, cloud: PointCloud, extrinsics: Transforms | None, found: Vertical) -> dict[str, Any]:
        if found.height is None and self.state.ground is not None:
            found = replace(found, height=self.state.ground.height)
        T = _on_base(found)
        down, roll = _down_and_roll(found.up)
        self.state.figures = {"looks down (°)": round(down, 1), "roll (°)": round(roll, 1)}
        self.state.figures |= {"sigma (°)": round(float(np.degrees(found.sigma)), 1), "height (m)": round(T[2, 3], 3)}
        guess = found.doubt > 1
        ground = "no ground in sight" if found.height is None else f"{found.height:.2f} m above the ground"
        text = f"the camera looks {_look(found.up)}, {ground}"
        text = f"few surfaces show where up is; taken so: {text}" if guess else text
        self.state.counts["guesses"] += guess
        made = with_transform(extrinsics, cloud.stamp, self.base_frame, cloud.frame, T)
        self.state.T, self.state.known = T, _digest(extrinsics)
        level = Level.WARN if guess else Level.OK
        figures = {key: f"{value:g}" for key, value in self.state.figures.items()}
        return {"base_extrinsics": made, "status": counted_status("camera_mount", cloud.stamp, text, level, figures)}

    def summary(self) -> Mapping[str, float | int | str]:
        """Returns counts and how the camera looked."""
        return {**self.state.counts, **self.state.figures}

    def finding(self) -> str:
        """Returns by how much the given base is wrong."""
        return self.state.finding


def _digest(extrinsics: Transforms | None) -> bytes:
    return b"" if extrinsics is None else extrinsics.digest()


def _down_and_roll(up: Array) -> tuple[float, float]:
    """Returns by how much a camera looks down and is rolled, degrees, where `up` (3,) is up in its optical frame."""
    return float(np.degrees(np.arcsin(np.clip(-up[2], -1, 1)))), float(np.degrees(np.arctan2(up[0], -up[1])))


def _look(up: Array) -> str:
    down, roll = _down_and_roll(up)
    return f"{round(down)}° down, turned by {round(roll)}°"


def _on_base(found: Vertical) -> Array:
    """Returns the pose (4, 4) of the camera on its base."""
    ahead = np.array([0.0, 0.0, 1.0]) if abs(found.up[2]) < 0.99 else np.array([0.0, -1.0, 0.0])
    x = ahead - (ahead @ found.up) * found.up
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(found.up, x), found.up])
    T[2, 3] = 0.0 if found.height is None else found.height
    return T
