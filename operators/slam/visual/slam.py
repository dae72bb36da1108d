"""SLAM with an RGB-D camera as an operator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from dataflow.messages import DepthImage, Diagnostics, Image, Odometry, Path, PointCloud, Transforms
from dataflow.messages.geometry import transform_points
from dataflow.operator import Counts, Out, Param
from operators.cloud.filtering import Voxels
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.odometry import RgbdOperator
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.tracking import LEVELS, outputs
from operators.slam.emission import corrections, map_due, map_poses, path_of, sizes, status_of
from operators.slam.keyframe_graph import Node
from operators.slam.visual.graph import GraphSettings
from operators.slam.visual.map_file import read_visual_map, write_visual_map
from operators.slam.visual.mapper import RgbdSlam, SlamResult, SlamState
from operators.slam.visual.view import STRIDE, Judge, View
from operators.status import counted_status


def cloud_of(nodes: Iterable[Node[View]], voxel: float, frame: str, stamp: int) -> PointCloud:
    """Returns what the views of nodes saw, in the map, thinned to a mean point in each voxel; grey as it was seen."""
    points, shades = [np.zeros((0, 3))], [np.zeros(0, np.uint8)]
    for node in nodes:
        if node.view is not None:
            points.append(transform_points(node.T, node.view.surface.points(STRIDE)))
            shades.append(node.view.shades)
    everything = np.concatenate(points).astype(np.float32)
    voxels = Voxels.by_size(everything, voxel)
    grey = np.rint(voxels.means(np.concatenate(shades))).astype(np.uint8)
    return PointCloud(
        stamp=stamp,
        frame=frame,
        points=voxels.means(everything).astype(np.float32),
        colors=np.repeat(grey[:, None], 3, axis=1),
    )


@dataclass(kw_only=True)
class State(Counts):
    """Holds the odometry and the map, and counts frames by place, and loops that were refused."""

    slam: SlamState


class VisualSlam(RgbdOperator):
    """Maps with an RGB-D camera, and corrects the drift of its odometry where it sees again what it saw before.

    In front runs the odometry of `VisualOdometry`, whose poses stay smooth; what is corrected is the transform from map
    to odometry frame (REP 105). Keyframes that look alike, or that the map has near each other, are compared by
    features and depth; a loop is closed only where both agree; an unexpected one also needs a second view that agrees,
    neither of them resting on one plane, since the patterns of floors and walls repeat. A pose graph with a robust
    kernel moves all keyframes accordingly; the newest, and the points that three or more have seen, are adjusted
    together at every keyframe. A place that was seen before keeps its old view, so the map grows with the space that
    is seen.

    With `map_file` the camera is looked for in a saved map, whose keyframes stay where they are; until it is found
    there is neither pose nor correction. Images as for `VisualOdometry`.

    Methods: pose graph of Grisetti et al., "A tutorial on graph-based SLAM", 2010, with the kernel of Yang et al.,
    "Graduated non-convexity", 2020; bundle adjustment of Triggs et al., "Bundle adjustment, a modern synthesis", 2000,
    with depths; places by McCann and Lowe, "Local naive Bayes nearest neighbor for image classification", 2012; the
    whole as in Endres et al., "3-D mapping with an RGB-D camera", 2014.
    """

    odometry: Out[Odometry] = Out(doc="the depth camera in the odometry frame, never corrected; at every frame")
    correction: Out[Transforms] = Out(doc="the odometry frame in the map frame (REP 105), while it is known")
    pose: Out[Odometry] = Out(doc="the depth camera in the map frame, with covariance, while it is known")
    path: Out[Path] = Out(doc="all keyframes as the map has them now, with their times; at every loop")
    map: Out[PointCloud] = Out(doc="points of all views, at every loop and every `period` keyframes")
    status: Out[Diagnostics] = Out(doc="mapped, corrected, searching or adrift, with the reason; then the odometry's")

    map_frame: str = Param("map", min_length=1, doc="name of the map's frame, the odometry's at first")
    map_file: str | None = Param(None, doc="saved map to be found in; a new map begins if none")
    save: str | None = Param(None, doc="file that the map is written to at the end")
    spacing: float = Param(0.2, gt=0, doc="change of view between keyframes: angle + baseline / depth", unit="rad")
    travel: float = Param(1.5, gt=0, doc="change of view along the way that a loop closes", unit="rad")
    candidates: int = Param(2, ge=1, doc="views compared with, of those nearby and of those that look alike")
    min_inliers: int = Param(20, ge=7, doc="fewest features that a loop may rest on")
    min_overlap: float = Param(0.2, gt=0, le=1, doc="least share of the depth image that both views see")
    min_agreement: float = Param(0.8, gt=0, le=1, doc="least share of that which lies on the same surfaces")
    voxel: float = Param(0.05, gt=0.005, doc="side of the voxels that the map's points are thinned to", unit="m")
    period: int = Param(10, ge=1, tunable=True, doc="keyframes from map to map")

    state: State

    def setup(self) -> None:
        """Raises FileNotFoundError or ValueError for a saved map that is none, or a depth sensor that is not known."""
        super().setup()
        self._known = None if self.map_file is None else read_visual_map(FilePath(self.use_file(self.map_file)))

    def initial_state(self) -> State:
        slam = SlamState.begun(self._config(), self._settings())
        if self._known is not None:
            slam.graph.begin_in(self._known)
        return State(slam=slam)

    def _tracked(self, camera: RgbdCamera, image: Image, depth: DepthImage) -> dict[str, Any]:
        graph = self.state.slam.graph
        result = RgbdSlam(camera, self._config(), self.state.slam).track(image.data, depth.data, depth.stamp)
        self.state.counts.update({result.place.value: 1})
        self.state.counts.update(f"refused: {reason}" for reason in result.added.refused)
        messages = outputs(result.odometry, self.odometry_frame, depth.frame)
        messages["status"] = self._status(result)
        if result.T_map_odom is not None:
            odometry, T = messages["odometry"], result.odometry.T_world_camera
            messages |= corrections(odometry, T, result.T_map_odom, result.covariance, self.map_frame)
        if result.added.loops:
            messages["path"] = path_of(map_poses(graph), self.map_frame, depth.stamp)
        if map_due(graph, result.added, self.period):
            messages["map"] = cloud_of(graph.nodes.values(), self.voxel, self.map_frame, depth.stamp)
        return messages

    def finish(self) -> None:
        """Writes the map."""
        if self.save is not None and self._camera is not None:
            write_visual_map(self.state.slam.graph, FilePath(self.save).expanduser())

    def summary(self) -> Mapping[str, float | int]:
        """Returns the number of frames of each state, of loops, and of views that were refused, by reason."""
        return dict(self.state.counts) | ({} if self._camera is None else sizes(self.state.slam.graph))

    def _status(self, result: SlamResult) -> Diagnostics:
        """The map's state, then the odometry's."""
        odometry = result.odometry
        own = counted_status(
            "visual_odometry",
            odometry.stamp,
            f"{odometry.status}: {odometry.reason}",
            LEVELS[odometry.status],
            {"inliers": odometry.inliers},
        )
        return status_of("visual_slam", result.place, result.reason, sizes(self.state.slam.graph), own)

    def _config(self) -> RgbdOdometryConfig:
        return RgbdOdometryConfig(near=self.near, far=self.far, depth_noise=self._noise)

    def _settings(self) -> GraphSettings:
        return GraphSettings(
            spacing=self.spacing,
            travel=self.travel,
            near=self.candidates,
            alike=self.candidates,
            searched=2 * self.candidates,
            judge=Judge(self.min_inliers, self.min_overlap, self.min_agreement),
        )
