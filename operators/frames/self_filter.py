"""Clouds and depth images without the robot's own body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.body import BodyPart, in_body
from operators.geometry.calibration import check_calibration
from operators.geometry.frame_tree import FrameTree, told_by
from operators.geometry.se3 import Matrix
from operators.status import counted_status

_FIELDS = ("points", "colors", "intensities", "rings", "time_offsets", "normals")


class RobotBody:
    """Parts of a robot in the frame of a sensor, each on a frame of the tree that the given transforms make."""

    def __init__(self, parts: Sequence[BodyPart], base_frame: str) -> None:
        self._parts, self._base = parts, base_frame
        self._known: dict[str, Transforms] | None = None
        self._seen: dict[str, list[tuple[BodyPart, Matrix]]] = {}

    def seen_from(self, sensor: str, transforms: Mapping[str, Transforms]) -> list[tuple[BodyPart, Matrix]]:
        """Returns each part with `T_sensor_part` (4, 4), by the newest transforms of each stream.

        Raises ValueError where a transform on the way is missing, or they contradict each other.
        """
        if self._known is None or any(self._known.get(name) is not given for name, given in transforms.items()):
            self._known, self._seen = dict(transforms), {}
        if sensor not in self._seen:
            tree = FrameTree()
            for given in transforms.values():
                for told in told_by(given):
                    tree.fix(*told)
            frames = {part.frame or self._base for part in self._parts}
            at = {frame: np.eye(4) if frame == sensor else tree.lookup(sensor, frame, 0) for frame in sorted(frames)}
            self._seen[sensor] = [(part, at[part.frame or self._base] @ part.pose()) for part in self._parts]
        return self._seen[sensor]


class _SelfFilter(Operator, abstract=True):
    body: tuple[BodyPart, ...] = Param(doc="parts of the robot")
    base_frame: str = Param("base_link", min_length=1, doc="frame of the parts that name none")
    padding: float = Param(0.03, ge=0, tunable=True, doc="parts are so much larger on every side", unit="m")
    state: Counts

    def setup(self) -> None:
        """Raises ValueError for a body without parts."""
        if not self.body:
            raise ValueError("body must have at least one part: a box or a cylinder")
        self._robot = RobotBody(self.body, self.base_frame)


class SelfFilter(_SelfFilter):
    """Removes the points of a cloud that lie in the robot's own body: boxes and cylinders on its frames.

    Their colours and other fields go with them; points that are NaN stay. Parts may move: transforms come from any
    number of streams, the newest of each counts.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor")
    transforms: Sampled[Transforms] = Sampled(
        many=True, required=False, doc="extrinsics, and frames of parts that move; none where all is one frame"
    )
    filtered: Out[PointCloud] = Out(doc="the cloud without the robot")
    status: Out[Diagnostics] = Out(doc="points given and removed; a warning where most were the robot's")

    def process(self, cloud: PointCloud, transforms: Mapping[str, Transforms] | None = None) -> dict[str, Any]:
        """Raises ValueError where no transforms lead from the cloud's frame to a part's."""
        own = in_body(cloud.points, self._robot.seen_from(cloud.frame, transforms or {}), self.padding)
        counts = {"points": cloud.count, "removed": int(own.sum())}
        self.state.counts.update(counts | {"clouds": 1})
        filtered = cloud
        if own.any():
            given = {name: value for name in _FIELDS if (value := getattr(cloud, name)) is not None}
            filtered = cloud.replace(**{name: value[~own] for name, value in given.items()})
        return {"filtered": filtered, "status": _status("self_filter", cloud.stamp, "points", counts)}


class DepthSelfFilter(_SelfFilter):
    """Removes the returns of a depth image that lie in the robot's own body: boxes and cylinders on its frames.

    They become pixels without return. Parts may move: transforms come from any number of streams, the newest of each
    counts. The image must be free of lens distortion.
    """

    depth: In[DepthImage] = In(doc="depth, metres")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    transforms: Sampled[Transforms] = Sampled(
        many=True, required=False, doc="extrinsics, and frames of parts that move; none where all is one frame"
    )
    filtered: Out[DepthImage] = Out(doc="the same without the robot; 0 for no return")
    status: Out[Diagnostics] = Out(doc="returns given and removed; a warning where most were the robot's")

    def process(
        self, depth: DepthImage, depth_info: CameraInfo, transforms: Mapping[str, Transforms] | None = None
    ) -> dict[str, Any]:
        """Raises ValueError where the image does not fit its calibration, or no transforms lead to a part's frame."""
        check_calibration("depth", depth, depth_info)
        parts = self._robot.seen_from(depth.frame, transforms or {})
        reach = max(float(T[2, 3]) + part.radius(self.padding) for part, T in parts)
        given = np.isfinite(depth.data) & (depth.data > 0)
        rows, columns = np.nonzero(given & (depth.data <= reach))
        z = depth.data[rows, columns].astype(np.float64)
        K = depth_info.K
        points = np.column_stack([(columns - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z])
        own = in_body(points, parts, self.padding)
        data = np.where(given, depth.data, 0).astype(np.float32)
        data[rows[own], columns[own]] = 0
        counts = {"returns": int(given.sum()), "removed": int(own.sum())}
        self.state.counts.update(counts | {"images": 1})
        return {
            "filtered": depth.replace(data=data),
            "status": _status("depth_self_filter", depth.stamp, "returns", counts),
        }


def _status(name: str, stamp: int, what: str, counts: Mapping[str, int]) -> Diagnostics:
    text, level = f"{counts['removed']} of {counts[what]} {what} are the robot's own", Level.OK
    if counts["removed"] * 2 > counts[what]:
        level = Level.WARN
    return counted_status(name, stamp, text, level, counts)
