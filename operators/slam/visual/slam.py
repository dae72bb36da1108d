"""SLAM with an RGB-D camera as an operator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from dataflow.messages import (
    CameraInfo,
    DepthImage,
    Diagnostics,
    Image,
    Message,
    Odometry,
    Path,
    PointCloud,
    Transforms,
)
from dataflow.messages.geometry import transform_points
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.filtering import Voxels
from operators.geometry.calibration import check_calibration
from operators.geometry.depth_sensors import DEPTH_SENSOR, DepthSensor, read_depth_sensor
from operators.odometry.emission import LEVELS as ODOMETRY_LEVELS
from operators.odometry.emission import outputs
from operators.odometry.rgbd.odometry import Calibration, camera_of, same
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import DepthNoise
from operators.slam.emission import corrections, map_poses, path_of, sizes, status_of
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


class VisualSlam(Operator):
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

    image: In[Image] = In(doc="colour or grey, of the same stamp")
    depth: In[DepthImage] = In(doc="depth, metres")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the colour camera")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the two cameras' frames, in either direction"
    )
    odometry: Out[Odometry] = Out(doc="the depth camera in the odometry frame, never corrected; at every frame")
    correction: Out[Transforms] = Out(doc="the odometry frame in the map frame (REP 105), while it is known")
    pose: Out[Odometry] = Out(doc="the depth camera in the map frame, with covariance, while it is known")
    path: Out[Path] = Out(doc="all keyframes as the map has them now, with their times; at every loop")
    map: Out[PointCloud] = Out(doc="points of all views, at every loop and every `period` keyframes")
    status: Out[Diagnostics] = Out(doc="mapped, corrected, searching or adrift, with the reason; then the odometry's")

    map_frame: str = Param("map", min_length=1, doc="name of the map's frame, the odometry's at first")
    odometry_frame: str = Param("odom", min_length=1, doc="name of the frame that the first depth camera defines")
    map_file: str | None = Param(None, doc="saved map to be found in; a new map begins if none")
    save: str | None = Param(None, doc="file that the map is written to at the end")
    near: float = Param(0.3, gt=0, doc="smaller depths are no return", unit="m")
    far: float = Param(6.0, gt=0, doc="larger depths are no return", unit="m")
    depth_sensor: str = Param("", doc=DEPTH_SENSOR)
    depth_noise_floor: float | None = Param(
        None, gt=0, doc="standard deviation of a near depth; none is the sensor's, 0.002 without one", unit="m"
    )
    depth_noise_quadratic: float | None = Param(
        None, ge=0, doc="and what it grows by per depth squared; none is the sensor's, 0.002 without one", unit="1/m"
    )
    spacing: float = Param(0.2, gt=0, doc="change of view between keyframes: angle + baseline / depth", unit="rad")
    travel: float = Param(1.5, gt=0, doc="change of view along the way that a loop closes", unit="rad")
    candidates: int = Param(2, ge=1, doc="views compared with, of those nearby and of those that look alike")
    min_inliers: int = Param(20, ge=7, doc="fewest features that a loop may rest on")
    min_overlap: float = Param(0.2, gt=0, le=1, doc="least share of the depth image that both views see")
    min_agreement: float = Param(0.8, gt=0, le=1, doc="least share of that which lies on the same surfaces")
    voxel: float = Param(0.05, gt=0.005, doc="side of the voxels that the map's points are thinned to", unit="m")
    period: int = Param(10, ge=1, tunable=True, doc="keyframes from map to map")

    state: State
    _slam: RgbdSlam | None = None
    _calibration: Calibration | None = None
    _sensor: DepthSensor | None = None

    def setup(self) -> None:
        """Raises FileNotFoundError or ValueError for a saved map that is none, or a depth sensor that is not known."""
        self._sensor = read_depth_sensor(self.depth_sensor, self.use_file)
        self._known = None if self.map_file is None else read_visual_map(FilePath(self.use_file(self.map_file)))

    def initial_state(self) -> State:
        slam = SlamState.begun(self._config(), self._settings())
        if self._known is not None:
            slam.graph.begin_in(self._known)
        return State(slam=slam)

    def on_reset(self, input: str) -> None:
        """Begins a new map, or a new search in the saved one: the clock of a stream began anew."""
        super().on_reset(input)
        self._slam = self._calibration = None

    def process(
        self,
        image: Image,
        depth: DepthImage,
        image_info: CameraInfo,
        depth_info: CameraInfo,
        extrinsics: Transforms | None = None,
    ) -> dict[str, Message]:
        """Raises ValueError where an image does not fit its calibration, that changes, or no transform fits."""
        check_calibration("image", image, image_info)
        check_calibration("depth", depth, depth_info)
        slam = self._running(image_info, depth_info, extrinsics)
        result = slam.track(image.data, depth.data, depth.stamp)
        self.state.counts.update({result.place.value: 1})
        self.state.counts.update(f"refused: {reason}" for reason in result.added.refused)
        messages: dict[str, Message] = outputs(result.odometry, self.odometry_frame, depth.frame)
        messages["status"] = self._status(result, slam)
        odometry, T = messages["odometry"], result.odometry.T_world_camera
        if result.T_map_odom is not None and isinstance(odometry, Odometry):
            messages |= corrections(odometry, T, result.T_map_odom, result.covariance, self.map_frame)
        if result.added.loops:
            messages["path"] = path_of(map_poses(slam.graph), self.map_frame, depth.stamp)
        if slam.graph.located and self._map_due(result, slam):
            messages["map"] = cloud_of(slam.graph.nodes.values(), self.voxel, self.map_frame, depth.stamp)
        return messages

    def finish(self) -> None:
        """Writes the map."""
        if self.save is not None and self._slam is not None:
            write_visual_map(self._slam.graph, FilePath(self.save).expanduser())

    def summary(self) -> Mapping[str, float | int]:
        """Returns the number of frames of each state, of loops, and of views that were refused, by reason."""
        kept = {} if self._slam is None else sizes(self._slam.graph) | {"loops": self._slam.graph.loops}
        return dict(self.state.counts) | kept

    # -- what is sent ------------------------------------------------------------------------------------

    def _status(self, result: SlamResult, slam: RgbdSlam) -> Diagnostics:
        """The map's state, then the odometry's."""
        odometry = result.odometry
        own = counted_status(
            "visual_odometry",
            odometry.stamp,
            f"{odometry.status}: {odometry.reason}",
            ODOMETRY_LEVELS[odometry.status],
            {"inliers": odometry.inliers},
        )
        counts = sizes(slam.graph) | {"loops": slam.graph.loops}
        return status_of("visual_slam", result.place, result.reason, counts, own)

    def _map_due(self, result: SlamResult, slam: RgbdSlam) -> bool:
        return result.added.loops > 0 or (result.added.node and len(slam.graph.nodes) % self.period == 0)

    # -- what runs ---------------------------------------------------------------------------------------

    def _running(self, image_info: CameraInfo, depth_info: CameraInfo, extrinsics: Transforms | None) -> RgbdSlam:
        """The tracker and its map, made for the first calibration, which later ones must repeat."""
        if self._slam is None:
            camera = camera_of(image_info, depth_info, extrinsics)
            self._slam = RgbdSlam(camera, self._config(), self.state.slam)
        elif not same(self._calibration, (image_info, depth_info, extrinsics)):
            self._slam.camera.check_same(camera_of(image_info, depth_info, extrinsics))
        self._calibration = (image_info, depth_info, extrinsics)
        return self._slam

    def _config(self) -> RgbdOdometryConfig:
        noise = DepthNoise.of(self._sensor, self.depth_noise_floor, self.depth_noise_quadratic)
        return RgbdOdometryConfig(near=self.near, far=self.far, depth_noise=noise)

    def _settings(self) -> GraphSettings:
        return GraphSettings(
            spacing=self.spacing,
            travel=self.travel,
            near=self.candidates,
            alike=self.candidates,
            searched=2 * self.candidates,
            judge=Judge(self.min_inliers, self.min_overlap, self.min_agreement),
        )
