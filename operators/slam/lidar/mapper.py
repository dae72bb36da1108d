"""LiDAR SLAM: odometry in front, a graph of its keyframes behind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.odometry.lidar.tracker import Tracked
from operators.odometry.tracking import Status
from operators.slam.lidar.graph import LidarGraph
from operators.slam.lidar.view import LidarView
from operators.slam.place import MappingResult, mapped
from operators.slam.sensor_model import KeyframeResult


class LidarMapper(Remembered):
    """Puts the scans that an odometry has tracked into a map. Deterministic: the same scans give the same bytes."""

    graph: LidarGraph
    _segment: int  # the odometry's maps, counted
    _lost: bool
    _jumped: bool  # the odometry found its map again, and no keyframe has told the graph

    def __init__(self, graph: LidarGraph, view: Callable[[NDArray[np.float32]], LidarView]) -> None:
        self.graph, self._view = graph, view
        self._segment, self._lost, self._jumped = 0, False, False

    def take(self, tracked: Tracked, stamp: int) -> MappingResult:
        """Takes what the odometry made of the next scan."""
        if self._lost and tracked.state is Status.TRACKING:
            self._segment += 1  # it is lost until it finds its map again, or begins a new one
        self._lost = tracked.state is Status.LOST
        self._jumped |= tracked.state is Status.RELOCALISED
        added = KeyframeResult()
        if tracked.points is not None:
            view = self._view(tracked.points.astype(np.float32))
            added = self.graph.add(stamp, tracked.T, tracked.covariance, view, self._segment, self._jumped)
            self._jumped &= not added.node
        known = self.graph.located and not self._lost
        return mapped(self.graph, added, tracked.state, tracked.reason, tracked.T, tracked.covariance, known)
