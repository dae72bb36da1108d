"""Holds what perception makes of one step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from dataflow.messages import (
    Activity,
    Boxes3D,
    Detections2D,
    Diagnostics,
    Message,
    Odometry,
    PointCloud,
    SceneGraph,
    SegmentationMap,
    Tracks,
)


@dataclass(frozen=True, slots=True)
class PerceptionResult:
    """The messages of one step; None for what the sensors of that step do not give.

    `stamp` (ns) is that of the step. `cloud` is in the frame of the depth camera or the LiDAR, `boxes` too; `pose`,
    `objects` and `graph` are in the frame in which the robot's base began, z up. `pose` is the newest where several
    came in one step, and then `poses` has all.
    """

    stamp: int
    detections: Detections2D | None = None
    """Boxes in the image."""
    segmentation: SegmentationMap | None = None
    """Class of every pixel."""
    tracks: Tracks | None = None
    """Boxes with the ids that they keep from image to image."""
    cloud: PointCloud | None = None
    """Points, coloured where they come from depth and image."""
    boxes: Boxes3D | None = None
    """Upright boxes around what is seen of the objects of this image."""
    pose: Odometry | None = None
    """The robot's base in the frame where it began."""
    objects: Boxes3D | None = None
    """The map's objects that are surely there."""
    graph: SceneGraph | None = None
    """Nodes and relations."""
    activities: Activity | None = None
    """Acts of every agent."""
    changes: Diagnostics | None = None
    """Nodes and relations that began and ended."""
    poses: tuple[Odometry, ...] = ()
    """Every pose of the step."""
    status: Mapping[str, Diagnostics] = field(default_factory=dict)
    """Each operator's newest word of the step about what its results rest on."""

    @property
    def masks(self) -> SegmentationMap | None:
        """The segmentation by its other name."""
        return self.segmentation

    def made(self) -> dict[str, Message]:
        """The messages that are there, by name."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in found.items() if isinstance(value, Message)}
