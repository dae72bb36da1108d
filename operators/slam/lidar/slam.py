"""SLAM with a LiDAR as an operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Message, Odometry, Path, PointCloud, Transforms
from dataflow.messages.geometry import invert, transform_points
from dataflow.operator import KEPT, Out, Param
from operators.cloud.registration import Settings
from operators.geometry.se3 import Matrix, adjoint
from operators.odometry.lidar.odometry import LidarOdometry, LidarState
from operators.slam.emission import corrections, map_due, map_poses, path_of, sizes, status_of
from operators.slam.lidar.graph import LidarGraph, LidarSettings
from operators.slam.lidar.map_file import points_of, read_lidar_map, write_lidar_map
from operators.slam.lidar.mapper import LidarMapper
from operators.slam.lidar.view import LidarEyes, LidarView


@dataclass(kw_only=True)
class SlamState(LidarState):
    """Holds the map beside the odometry, and counts scans by place, and keyframes that were refused."""

    mapper: LidarMapper
    places: Counter[str] = field(default_factory=Counter, metadata=KEPT)


class LidarSlam(LidarOdometry):
    """Maps with a LiDAR, and corrects the drift of its odometry where it sees again what it saw before.

    In front runs the odometry of `LidarOdometry`, with its parameters and its `odometry`, which stays smooth; what is
    corrected is the transform from map to odometry frame (REP 105). Keyframes are measured against the planes of older
    ones that the map has nearby. A loop is closed only where each scan confirms the other's surfaces and nothing hangs
    in space that the other saw to be free; an unexpected one also needs a second keyframe that agrees. A pose graph
    with a robust kernel moves all keyframes accordingly. A place that was seen before keeps its old scan, so the map
    grows with the space that is seen.

    With `map_file` the LiDAR is looked for in a saved map, whose keyframes stay where they are; until it is found there
    is neither pose nor correction. Places that look alike are searched in all headings; where two poses or two places
    explain the scan as well, none is believed.

    Methods: pose graph of Grisetti et al., "A tutorial on graph-based SLAM", 2010, with the kernel of Yang et al.,
    "Graduated non-convexity", 2020; places by Kim and Kim, "Scan context", 2018; scans against the map around a
    keyframe as in Shan et al., "LIO-SAM", 2020, registered by Segal et al., "Generalized-ICP", 2009.
    """

    correction: Out[Transforms] = Out(doc="the odometry frame in the map frame (REP 105), while it is known")
    pose: Out[Odometry] = Out(doc="the body in the map frame, with covariance, while it is known")
    path: Out[Path] = Out(doc="all keyframes as the map has them now, with their times; at every loop")
    map: Out[PointCloud] = Out(doc="points of all keyframes, at every loop and every `period` keyframes")
    status: Out[Diagnostics] = Out(doc="mapped, corrected, searching or adrift, with the reason; then the odometry's")

    map_frame: str = Param("map", min_length=1, doc="name of the map's frame, the odometry's at first")
    map_file: str | None = Param(None, doc="saved map to be found in; a new map begins if none")
    save: str | None = Param(None, doc="file that the map is written to at the end")
    keyframe: float = Param(0.5, gt=0, doc="way between keyframes; a turn by a radian counts half a metre", unit="m")
    travel: float = Param(4.0, gt=0, doc="way between two keyframes that a loop may join", unit="m")
    reach: float = Param(1.0, gt=0, doc="distance at which the map expects that a place is seen again", unit="m")
    candidates: int = Param(2, ge=1, doc="keyframes compared with, of those nearby and of those that look alike")
    place_range: float = Param(10.0, gt=1, doc="farther points do not describe a place", unit="m")
    map_voxel: float = Param(0.1, gt=0.01, doc="side of the voxels by which scans are compared and shown", unit="m")
    min_overlap: float = Param(0.5, gt=0, le=1, doc="least share of a scan that the other could see")
    min_fitness: float = Param(0.85, gt=0, le=1, doc="least share of that which agrees")
    max_violation: float = Param(
        0.04, ge=0, lt=0.5, doc="most of a scan that hangs in what the other saw to be free; twice that where expected"
    )
    period: int = Param(10, ge=1, tunable=True, doc="keyframes from map to map")

    state: SlamState

    def setup(self) -> None:
        """Raises FileNotFoundError or ValueError for a saved map that is none."""
        super().setup()
        self._known = None if self.map_file is None else read_lidar_map(FilePath(self.use_file(self.map_file)))

    def initial_state(self) -> SlamState:
        return SlamState(tracker=self._new(), mapper=self._new_mapper())

    def process(self, cloud: PointCloud, extrinsics: Transforms | None = None) -> Mapping[str, Message]:
        """Raises ValueError where no transform relates the cloud's frame to the body's."""
        messages, tracked, T_body_lidar = self._tracked(cloud, extrinsics)
        mapped = self.state.mapper.take(tracked, cloud.stamp)
        graph = self.state.mapper.graph
        self.state.places.update({mapped.place.value: 1})
        self.state.places.update(f"refused: {_kind(reason)}" for reason in mapped.added.refused)
        status, odometry = messages["status"], messages.get("odometry")
        assert isinstance(status, Diagnostics)
        messages["status"] = status_of("lidar_slam", mapped.place, mapped.reason, sizes(graph), status)
        back = invert(T_body_lidar)
        if mapped.T_map_odom is not None and isinstance(odometry, Odometry):
            carried = adjoint(T_body_lidar)
            messages |= corrections(
                odometry,
                T_body_lidar @ tracked.T @ back,
                T_body_lidar @ mapped.T_map_odom @ back,
                carried @ mapped.covariance @ carried.T,
                self.map_frame,
            )
        if mapped.added.loops:
            poses = [(each, T_body_lidar @ T @ back) for each, T in map_poses(graph)]
            messages["path"] = path_of(poses, self.map_frame, cloud.stamp)
        if map_due(graph, mapped.added, self.period):
            messages["map"] = self._map(T_body_lidar, cloud.stamp)
        return messages

    def finish(self) -> None:
        """Writes the map."""
        if self.save is not None:
            write_lidar_map(self.state.mapper.graph, FilePath(self.save).expanduser())

    def summary(self) -> Mapping[str, float | int | str]:
        """Returns the number of scans of each state, of loops, and of keyframes that were refused, by reason."""
        return {**super().summary(), **self.state.places, **sizes(self.state.mapper.graph)}

    def _map(self, T_body_lidar: Matrix, stamp: int) -> PointCloud:
        points = points_of(self.state.mapper.graph.nodes.values(), self.map_voxel)
        placed = transform_points(T_body_lidar, points).astype(np.float32)
        return PointCloud(stamp=stamp, frame=self.map_frame, points=placed)

    def _new_mapper(self) -> LidarMapper:
        searched = Settings(self.map_voxel, 1, self.min_overlap, self.min_fitness, self.max_violation)
        expected = Settings(self.map_voxel, 1, self.min_overlap, self.min_fitness, 2 * self.max_violation)
        eyes = LidarEyes(searched, expected, self.noise, self.correlation, self.min_inliers)
        settings = LidarSettings(
            spacing=self.keyframe, travel=self.travel, reach=self.reach, same=0.5 * self.keyframe,
            near=self.candidates, searched=self.candidates + 1,
        )  # fmt: skip
        graph = LidarGraph(settings, eyes)
        if self._known is not None:
            graph.begin_in(self._known)
        return LidarMapper(graph, self._view)

    def _view(self, points: NDArray[np.float32]) -> LidarView:
        return LidarView(points, self.place_range, self.map_voxel)


def _kind(reason: str) -> str:
    """Returns a reason without its figures."""
    return reason.split(":")[0].split("% ")[-1]
