"""RGB-D SLAM: odometry in front, a graph of its keyframes behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.memory import from_plain, to_plain
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import scaled_intrinsics
from operators.odometry.rgbd.tracker import RgbdOdometry
from operators.odometry.tracking import Status, TrackResult
from operators.slam.graph_memory import graph_from_plain, graph_to_plain
from operators.slam.place import Place, place_of
from operators.slam.sensor_model import Added
from operators.slam.visual.graph import GraphSettings, VisualGraph
from operators.slam.visual.map_points import MapPoints
from operators.slam.visual.view import view_from_plain, view_to_plain


@dataclass(frozen=True, eq=False)
class SlamResult:
    """Holds what a frame gave. `T_map_odom` is None while the place in the map is not known."""

    odometry: TrackResult
    place: Place
    reason: str
    T_map_odom: Matrix | None
    covariance: Matrix  # (6, 6) of the camera's pose in the map, right perturbation
    added: Added


class RgbdSlam:
    """Maps with one camera. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, camera: RgbdCamera, config: RgbdOdometryConfig, settings: GraphSettings) -> None:
        self.camera, self._config = camera, config
        self._odometry = RgbdOdometry(camera, config)
        self.graph = VisualGraph(settings)
        self._jumped = False  # the odometry found its map again, and no keyframe has told the graph

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> SlamResult:
        """Returns the pose of the next frame, as `RgbdOdometry.track` does, and where its odometry lies in the map.

        Raises ValueError as that does.
        """
        result = self._odometry.track(image, depth, stamp)
        self._jumped |= result.status is Status.RELOCALISED
        if result.taken_back is not None:
            self.graph.withdraw(result.taken_back)
        added = Added()
        if result.keyframe:
            factor = max(1, image.shape[1] // self._config.image_width)
            working = replace(self.camera, K_color=scaled_intrinsics(self.camera.K_color, 1.0 / factor))
            state = self._odometry.snapshot()
            added = self.graph.add(state.keyframes[-1], Fitter(working, self._config, state.noise), self._jumped)
            self._jumped &= not added.node
        missing = result.status in (Status.PREDICTED, Status.LOST)
        adrift = f"odometry {result.status}: {result.reason}" if missing else ""
        place, reason = place_of(self.graph, added, adrift, result.reason)
        known = self.graph.located
        return SlamResult(
            odometry=result,
            place=place,
            reason=reason,
            T_map_odom=self.graph.T_map_odom.copy() if known else None,
            covariance=self.graph.covariance_at(result.T_world_camera, result.covariance),
            added=added,
        )

    def snapshot(self) -> Mapping[str, Any]:
        """Returns all that the next result depends on, as plain values."""
        return {
            "odometry": to_plain(self._odometry.snapshot()),
            "graph": graph_to_plain(self.graph, view_to_plain),
            "points": self.graph.points.to_plain(),
            "jumped": self._jumped,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Goes on from a snapshot of the same camera and settings."""
        self._odometry.restore(from_plain(state["odometry"]))
        graph_from_plain(self.graph, state["graph"], view_from_plain)
        self.graph.points = MapPoints.from_plain(state["points"])
        self._jumped = bool(state["jumped"])
