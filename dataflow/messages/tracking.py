"""Objects followed over time, and landmarks seen."""

from __future__ import annotations

from enum import IntEnum

from dataflow.messages.arrays import F32, F64, I32, I64, U8
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import (
    ordered_boxes,
    positive,
    table_indices,
    together,
    unique,
    unit_quaternions,
    within,
    within_length,
)
from dataflow.messages.detection import CLASS_NAMES, labels_of


class TrackState(IntEnum):
    """The life of a track."""

    TENTATIVE = 0
    """seen, not yet often enough"""
    CONFIRMED = 1
    """matched in this update"""
    COASTING = 2
    """predicted, not matched in this update"""
    ENDED = 3
    """given up; listed once"""


class Tracks(Message):
    """Objects followed over time, in the image (`boxes`), in space (`positions`), or both."""

    frame: str = scalar(
        "str",
        "frame of positions and velocities; the camera's optical frame where there are only boxes",
        default=ANCHOR,
    )
    width: int | None = scalar("int", "columns of the image that `boxes` lie in, pixels", default=None)
    height: int | None = scalar("int", "rows of the image that `boxes` lie in, pixels", default=None)
    class_names: tuple[str, ...] = scalar("strs", CLASS_NAMES, default=())
    ids: I64 = array("int64", "N", "identity of each track, unique, never used again")
    states: U8 = array("uint8", "N", "`TrackState`: 0 tentative, 1 confirmed, 2 coasting, 3 ended")
    scores: F32 = array("float32", "N", "confidence, [0, 1]")
    class_ids: I32 = array("int32", "N", "index into `class_names`")
    ages: F32 = array("float32", "N", "time since the track was first seen", unit="s")
    unseen: F32 = array("float32", "N", "time since it was last matched; 0 when matched now", unit="s")
    boxes: F32 | None = array(
        "float32",
        "N 4",
        "(x1, y1, x2, y2), as in Detections2D; NaN for a track that is not in the image",
        unit="px",
        default=None,
    )
    positions: F64 | None = array(
        "float64", "N 3", "centre of each object; NaN where not known", unit="m", default=None
    )
    sizes: F64 | None = array(
        "float64", "N 3", "full extents along the object's own x, y and z; NaN where not known", unit="m", default=None
    )
    orientations: F64 | None = array(
        "float64", "N 4", "unit quaternions (x, y, z, w) that map the object's axes to `frame`", default=None
    )
    velocities: F64 | None = array("float64", "N 3", "velocity of each object, in `frame`", unit="m/s", default=None)
    covariances: F64 | None = array(
        "float64", "N 6 6", "of (position, velocity), in `frame`", unit="m, m/s", default=None
    )
    detections: I64 | None = array(
        "int64", "N", "row of the detections that it was matched with now; -1 for none", default=None, added=True
    )

    def validate(self) -> None:
        positive(self, "width", "height")
        together(self, "width", "height")
        unique(self, "ids")
        within_length(self, "states", len(TrackState), "be a TrackState: 0 tentative, 1 confirmed, 2 coasting, 3 ended")
        within(self, 0.0, 1.0, "scores")
        within(self, 0.0, float("inf"), "ages", "unseen")
        within(self, 0.0, float("inf"), "sizes", nan=True)
        table_indices(self, "class_ids", "class_names")
        ordered_boxes(self, "boxes", nan=True)
        unit_quaternions(self, "orientations")
        if self.boxes is None and self.positions is None and len(self.ids):
            raise MessageError(f"Tracks of {len(self.ids)} objects must have boxes or positions, got neither")

    @property
    def count(self) -> int:
        """Number of tracks."""
        return len(self.ids)

    def labels(self) -> tuple[str, ...]:
        """Class name of each track, or its class id as text where classes have no names."""
        return labels_of(self.class_ids, self.class_names)


class LandmarkSightings(Message):
    """Landmarks seen from the robot: fiducial tags, poles, beacons.

    Either polar (`ranges`, `bearings`, or both; `elevations` with bearings) or Cartesian (`positions`).
    """

    frame: str = scalar("str", "frame of the sensor", default=ANCHOR)
    family: str = scalar("str", "kind of landmark, such as a tag family; empty where there is only one", default="")
    ids: I64 = array("int64", "N", "identity of each landmark, -1 where unknown")
    ranges: F64 | None = array("float64", "N", "distance", unit="m", default=None)
    bearings: F64 | None = array("float64", "N", "angle from x towards y", unit="rad", default=None)
    elevations: F64 | None = array("float64", "N", "angle above the x-y plane", unit="rad", default=None)
    positions: F64 | None = array("float64", "N 2|N 3", "(x, y) or (x, y, z) in `frame`", unit="m", default=None)
    orientations: F64 | None = array(
        "float64", "N 4", "unit quaternions (x, y, z, w) that map the landmark's axes to `frame`", default=None
    )
    covariances: F64 | None = array(
        "float64",
        "N D D",
        "of the position, or of the polar fields given, in the order range, bearing, elevation",
        unit="m, rad",
        default=None,
    )

    def validate(self) -> None:
        polar = sum(x is not None for x in (self.ranges, self.bearings, self.elevations))
        if (self.positions is None) == (polar == 0):
            raise MessageError(
                "LandmarkSightings must be polar (ranges, bearings, or both) or Cartesian (positions), got "
                + ("both" if polar else "neither")
            )
        if self.elevations is not None and self.bearings is None:
            raise MessageError("LandmarkSightings.elevations is given without bearings: it needs them")
        unit_quaternions(self, "orientations")
        dimension = polar if self.positions is None else self.positions.shape[1]
        if self.covariances is not None and self.covariances.shape[1] != dimension:
            raise MessageError(
                f"LandmarkSightings.covariances must have shape (N, {dimension}, {dimension}), "
                f"got {self.covariances.shape}"
            )

    @property
    def count(self) -> int:
        """Number of sightings."""
        return len(self.ids)
