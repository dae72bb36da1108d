"""The points of a visual map."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dataflow.messages import PointCloud
from dataflow.messages.geometry import transform_points
from operators.cloud.filtering import Voxels
from operators.slam.keyframe_graph import Node
from operators.slam.visual.view import STRIDE, View


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
