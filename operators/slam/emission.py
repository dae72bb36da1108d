"""The messages that every SLAM makes of its map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dataflow.messages import Diagnostics, Message, Odometry, Path, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import matrix_to_quaternion
from operators.geometry.se3 import Matrix, about_fixed_axes
from operators.slam.place import Place
from operators.slam.place_graph import PlaceGraph
from operators.slam.sensor_model import KeyframeResult

LEVELS = {Place.MAPPED: Level.OK, Place.CORRECTED: Level.OK, Place.SEARCHING: Level.WARN, Place.ADRIFT: Level.WARN}


def corrections(
    odometry: Odometry, T_odom: Matrix, T_map_odom: Matrix, covariance: Matrix, map_frame: str
) -> dict[str, Message]:
    """Returns the ports `correction` and `pose` for the odometry's pose `T_odom` (4, 4).

    The covariance (6, 6) is of the pose's right perturbation.
    """
    T = T_map_odom @ T_odom
    return {
        "correction": Transforms.from_matrix(
            T_map_odom, stamp=odometry.stamp, frame=map_frame, child_frame=odometry.frame
        ),
        "pose": Odometry.from_matrix(
            T,
            stamp=odometry.stamp,
            frame=map_frame,
            child_frame=odometry.child_frame,
            linear=odometry.linear,
            angular=odometry.angular,
            pose_covariance=about_fixed_axes(covariance, T),
        ),
    }


def path_of(poses: list[tuple[int, Matrix]], map_frame: str, stamp: int) -> Path:
    """Returns keyframes, by time, as the map has them; without times where these do not rise (a map of another run)."""
    T, times = np.array([pose for _, pose in poses]), np.array([each for each, _ in poses], np.int64)
    return Path(
        stamp=stamp,
        frame=map_frame,
        positions=T[:, :3, 3],
        orientations=matrix_to_quaternion(T),
        stamps=times if (np.diff(times) > 0).all() else None,
    )


def map_poses(graph: PlaceGraph[Any]) -> list[tuple[int, Matrix]]:
    """Returns times and poses of the nodes whose place in the map is known."""
    return [(node.stamp, node.T) for node in graph.nodes.values() if node.island in graph.tied]


def map_due(graph: PlaceGraph[Any], added: KeyframeResult, period: int) -> bool:
    """Returns whether the map is sent after what was just added: at every loop and every `period` keyframes."""
    return graph.located and (added.loops > 0 or (added.node and len(graph.nodes) % period == 0))


def sizes(graph: PlaceGraph[Any]) -> dict[str, int]:
    """Returns the number of keyframes, of those that keep a view, and of loops."""
    nodes = graph.nodes.values()
    views = sum(node.view is not None for node in nodes)
    return {"keyframes": len(nodes), "views": views, "loops": graph.loops}


def status_of(name: str, place: Place, reason: str, counts: Mapping[str, int], odometry: Diagnostics) -> Diagnostics:
    """Returns the map's state, then the odometry's: one entry, with values."""
    return Diagnostics(
        stamp=odometry.stamp,
        names=(name, *odometry.names),
        messages=(f"{place}: {reason}", *odometry.messages),
        levels=np.array([LEVELS[place], *odometry.levels], np.uint8),
        keys=(*counts, *odometry.keys),
        values=(*map(str, counts.values()), *odometry.values),
        owners=np.array([0] * len(counts) + [1] * len(odometry.keys), np.int32),
    )
