"""Saved LiDAR maps: keyframes with the scan that each saw, and the clouds of such maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.cloud.filtering import Voxels
from operators.slam.keyframe_graph import Node
from operators.slam.lidar.graph import LidarGraph
from operators.slam.lidar.view import LidarView
from operators.slam.map_file import ends, joined, read_map, write_map

VERSION = 1
STRIDE = 3  # of the points of a view in the map's cloud


def write_lidar_map(graph: LidarGraph, path: Path) -> None:
    """Writes the scans of a graph whose place in the map is known. The same map gives the same bytes."""
    write_map(graph, path, VERSION, _packed)


def read_lidar_map(path: Path) -> list[Node[LidarView]]:
    """Returns the nodes of a saved map. Raises ValueError for a file that is none."""
    return read_map(path, "LiDAR", VERSION, _views)


def points_of(nodes: Iterable[Node[LidarView]], voxel: float) -> NDArray[np.float32]:
    """Returns what the scans of nodes saw, (N, 3) in the map, thinned to a mean point in each voxel."""
    points = [transform_points(node.T, node.view.points[::STRIDE]) for node in nodes if node.view is not None]
    everything = np.asarray(joined(points, (0, 3), np.float64)).astype(np.float32)
    return Voxels.by_size(everything, voxel).means(everything).astype(np.float32)


def _packed(views: Sequence[LidarView]) -> dict[str, Any]:
    return {
        "scanned": np.array([len(view.points) for view in views], np.int64),
        "points": joined([view.points for view in views], (0, 3), np.float32),
        "scales": np.array([(view.far, view.voxel) for view in views]).reshape(-1, 2),
    }


def _views(a: Mapping[str, Any]) -> list[LidarView]:
    scanned = ends(a["scanned"])
    return [
        LidarView(a["points"][scanned[k] : scanned[k + 1]], *(float(x) for x in scales))
        for k, scales in enumerate(a["scales"])
    ]
