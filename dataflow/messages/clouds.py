"""Point clouds and their partition into clusters."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dataflow.messages.arrays import F32, F64, I32, I64, U8, U16
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import within_length
from dataflow.messages.display import pictures
from dataflow.messages.display.pictures import Picture


class PointCloud(Message):
    """Points from a lidar, a depth camera or a map."""

    frame: str = scalar("str", "frame of the points", default=ANCHOR)
    points: F32 = array("float32", "N 3", "x, y, z of each point; NaN where there was no return", unit="m")
    colors: U8 | None = array("uint8", "N 3", "RGB of each point", default=None)
    intensities: F32 | None = array("float32", "N", "strength of the return, in the sensor's own scale", default=None)
    rings: U16 | None = array("uint16", "N", "laser channel of a spinning lidar, from 0", default=None)
    time_offsets: F32 | None = array(
        "float32", "N", "when each point was measured, relative to the stamp", unit="s", default=None
    )
    normals: F32 | None = array("float32", "N 3", "unit surface normals; NaN where not estimated", default=None)
    precise: F64 | None = array(
        "float64",
        "N 3",
        "the points as they were measured, where `points` cannot hold them (map coordinates)",
        unit="m",
        default=None,
        added=True,
    )
    columns: int | None = scalar(
        "int", "points of a row, of an organised cloud: row by row; None for others", default=None, added=True
    )

    def validate(self) -> None:
        if self.columns is not None and (self.columns < 1 or len(self.points) % self.columns):
            raise MessageError(f"PointCloud.columns must divide its {len(self.points)} points, got {self.columns}")

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.points)

    def _picture(self) -> Picture | None:
        return pictures.of_points(self.points)


class Clusters(Message):
    """A partition of a point cloud into clusters: the cloud of the same stamp, or the one the operator documents."""

    frame: str = scalar("str", "frame of the centroids and bounds", default=ANCHOR)
    labels: I32 = array("int32", "P", "cluster of each point of the cloud, -1 for none")
    centroids: F64 = array("float64", "N 3", "mean of each cluster's points", unit="m")
    lower: F64 | None = array("float64", "N 3", "smallest x, y, z of each cluster", unit="m", default=None)
    upper: F64 | None = array("float64", "N 3", "largest x, y, z of each cluster", unit="m", default=None)
    ids: I64 | None = array("int64", "N", "identity of each cluster over time", default=None)

    def validate(self) -> None:
        count = len(self.centroids)
        within_length(self, "labels", count, f"be -1 or index the {count} clusters of centroids", none=-1)

    @property
    def count(self) -> int:
        """Number of clusters."""
        return len(self.centroids)

    def indices(self, cluster: int) -> npt.NDArray[np.int64]:
        """Indices (M,) of the cloud's points in one cluster, ascending."""
        return np.flatnonzero(self.labels == cluster)
