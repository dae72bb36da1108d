"""RGB-D SLAM: odometry in front, a graph of its keyframes behind."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import scaled_intrinsics
from operators.odometry.rgbd.tracker import RgbdOdometry, RgbdState
from operators.odometry.tracking import Status, TrackResult
from operators.slam.place import MappingResult, mapped
from operators.slam.sensor_model import KeyframeResult
from operators.slam.visual.graph import GraphSettings, VisualGraph


@dataclass(frozen=True, eq=False)
class SlamResult(MappingResult):
    """Holds what a frame gave to the map, and what the odometry made of it."""

    odometry: TrackResult


@dataclass(eq=False)
class SlamState:
    """Holds the odometry's memory and the map. `jumped`: the odometry found its map again, and no keyframe has told
    the graph."""

    odometry: RgbdState
    graph: VisualGraph
    jumped: bool = False

    @staticmethod
    def begun(config: RgbdOdometryConfig, settings: GraphSettings) -> SlamState:
        """Returns the state before the first frame."""
        return SlamState(RgbdState(LocalMap(config.keyframes)), VisualGraph(settings))


class RgbdSlam:
    """Maps with one camera. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, camera: RgbdCamera, config: RgbdOdometryConfig, state: SlamState) -> None:
        self.camera, self._config, self.state, self.graph = camera, config, state, state.graph
        self._odometry = RgbdOdometry(camera, config, state.odometry)

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> SlamResult:
        """Returns the pose of the next frame, as `RgbdOdometry.track` does, and where its odometry lies in the map.

        Raises ValueError as that does.
        """
        result = self._odometry.track(image, depth, stamp)
        self.state.jumped |= result.status is Status.RELOCALISED
        if result.taken_back is not None:
            self.graph.withdraw(result.taken_back)
        added = KeyframeResult()
        if result.keyframe:
            factor = max(1, image.shape[1] // self._config.image_width)
            working = replace(self.camera, K_color=scaled_intrinsics(self.camera.K_color, 1.0 / factor))
            state = self._odometry.state
            added = self.graph.add(state.map.newest, Fitter(working, self._config, state.noise), self.state.jumped)
            self.state.jumped &= not added.node
        found = mapped(
            self.graph, added, result.status, result.reason, result.T_world_camera, result.covariance,
            self.graph.located,
        )  # fmt: skip
        return SlamResult(**vars(found), odometry=result)
