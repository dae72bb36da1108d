"""LiDAR SLAM: odometry in front, a graph of its keyframes behind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.geometry.se3 import Matrix
from operators.odometry.lidar.tracker import State, Tracked
from operators.slam.lidar.graph import LidarGraph
from operators.slam.lidar.view import LidarView
from operators.slam.place import Place, place_of
from operators.slam.sensor_model import Added


@dataclass(frozen=True, eq=False)
class Mapped:
    """Holds what a scan gave to the map. `T_map_odom` is None while the place in the map is not known."""

    place: Place
    reason: str
    T_map_odom: Matrix | None
    covariance: Matrix  # (6, 6) of the LiDAR's pose in the map, right perturbation
    added: Added


class LidarMapper(Remembered):
    """Puts the scans that an odometry has tracked into a map. Deterministic: the same scans give the same bytes."""

    graph: LidarGraph
    _segment: int  # the odometry's maps, counted
    _lost: bool
    _jumped: bool  # the odometry found its map again, and no keyframe has told the graph

    def __init__(self, graph: LidarGraph, view: Callable[[NDArray[np.float32]], LidarView]) -> None:
        self.graph, self._view = graph, view
        self._segment, self._lost, self._jumped = 0, False, False

    def take(self, tracked: Tracked, stamp: int) -> Mapped:
        """Takes what the odometry made of the next scan."""
        if self._lost and tracked.state is State.TRACKING:
            self._segment += 1  # it is lost until it finds its map again, or begins a new one
        self._lost = tracked.state is State.LOST
        self._jumped |= tracked.state is State.RELOCALISED
        added = Added()
        if tracked.points is not None:
            view = self._view(tracked.points.astype(np.float32))
            added = self.graph.add(stamp, tracked.T, tracked.covariance, view, self._segment, self._jumped)
            self._jumped &= not added.node
        missing = tracked.state in (State.PREDICTED, State.LOST)
        adrift = f"odometry {tracked.state}: {tracked.reason}" if missing else ""
        place, reason = place_of(self.graph, added, adrift, tracked.reason or "by odometry")
        return Mapped(
            place=place,
            reason=reason,
            T_map_odom=self.graph.T_map_odom.copy() if self.graph.located and not self._lost else None,
            covariance=self.graph.covariance_at(tracked.T, tracked.covariance),
            added=added,
        )
