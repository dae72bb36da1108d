"""Maps of the surroundings: occupancy grids, rooms, meshes, planes."""

from __future__ import annotations

from dataflow.messages.arrays import F32, F64, I8, I32, I64, U8, U32
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import positive, together, unique, unit_quaternions, unit_vectors, within, within_length
from dataflow.messages.display import pictures
from dataflow.messages.display.pictures import Picture
from dataflow.messages.geometry import transform_matrix


class OccupancyGrid(Message):
    """A grid of occupancy in a plane. Cell (row, column) covers x in [column, column + 1] * resolution and y in [row,
    row + 1] * resolution of the grid's own frame: row 0 is at the origin, y grows with the row."""

    frame: str = scalar("str", "frame in which the origin is expressed")
    resolution: float = scalar("float", "side of a cell, metres")
    cells: I8 = array("int8", "H W", "occupancy from 0 (free) to 100 (occupied), -1 for unknown", unit="%")
    position: F64 = array("float64", "3", "outer corner of cell (0, 0) in `frame`", unit="m")
    orientation: F64 | None = array(
        "float64",
        "4",
        "unit quaternion (x, y, z, w) of the grid's axes in `frame`; None for parallel axes",
        default=None,
    )

    def validate(self) -> None:
        positive(self, "resolution")
        unit_quaternions(self, "orientation")
        within_length(self, "cells", 101, "be -1 or lie in 0..100", none=-1)

    def matrix(self) -> F64:
        """`T_frame_grid` (4, 4)."""
        return transform_matrix(self.position, (0.0, 0.0, 0.0, 1.0) if self.orientation is None else self.orientation)

    def _picture(self) -> Picture | None:
        return pictures.of_occupancy(self.cells)


class Rooms(Message):
    """A floor divided into rooms, and the doors between them. Cells lie as those of an `OccupancyGrid`."""

    frame: str = scalar("str", "frame in which the origin is expressed")
    resolution: float = scalar("float", "side of a cell, metres")
    cells: I32 = array("int32", "H W", "room of each cell, an index into `ids`, -1 for none")
    position: F64 = array("float64", "3", "outer corner of cell (0, 0) in `frame`", unit="m")
    orientation: F64 | None = array(
        "float64",
        "4",
        "unit quaternion (x, y, z, w) of the grid's axes in `frame`; None for parallel axes",
        default=None,
    )
    ids: I64 = array("int64", "N", "identity of each room over time, unique")
    areas: F64 = array("float64", "N", "floor of each room that was seen", unit="m²")
    centers: F64 = array("float64", "N 3", "place in each room that is farthest from its walls, in `frame`", unit="m")
    doors: I32 = array("int32", "D 2", "the two rooms that each door joins, indices into `ids`")
    door_positions: F64 = array("float64", "D 3", "middle of each door, in `frame`", unit="m")
    door_widths: F64 = array("float64", "D", "clear width of each door", unit="m")

    def validate(self) -> None:
        rooms = len(self.ids)
        positive(self, "resolution")
        unit_quaternions(self, "orientation")
        unique(self, "ids")
        within_length(self, "cells", rooms, f"be -1 or index the {rooms} rooms of ids", none=-1)
        within_length(self, "doors", rooms, f"index the {rooms} rooms of ids")
        within(self, 0.0, float("inf"), "areas", "door_widths")

    @property
    def count(self) -> int:
        """Number of rooms."""
        return len(self.ids)

    def matrix(self) -> F64:
        """`T_frame_grid` (4, 4)."""
        return transform_matrix(self.position, (0.0, 0.0, 0.0, 1.0) if self.orientation is None else self.orientation)

    def _picture(self) -> Picture | None:
        return pictures.of_classes(self.cells[::-1])


class Mesh(Message):
    """A triangle mesh."""

    frame: str = scalar("str", "frame of the vertices")
    vertices: F32 = array("float32", "V 3", "corners", unit="m")
    triangles: U32 = array("uint32", "T 3", "indices into the vertices, counter-clockwise seen from outside")
    colors: U8 | None = array("uint8", "V 3", "RGB of each vertex", default=None)
    normals: F32 | None = array("float32", "V 3", "unit normal of each vertex", default=None)

    def validate(self) -> None:
        count = len(self.vertices)
        within_length(self, "triangles", count, f"index the {count} vertices")


class Planes(Message):
    """Planes found in a cloud: walls, floors, table tops. A point p lies on plane i where n·p + d = 0."""

    frame: str = scalar("str", "frame of the planes", default=ANCHOR)
    coefficients: F64 = array("float64", "N 4", "(nx, ny, nz, d), n of unit length", unit="m (d)")
    centers: F64 | None = array(
        "float64", "N 3", "middle of the part of each plane that was seen", unit="m", default=None
    )
    orientations: F64 | None = array(
        "float64",
        "N 4",
        "unit quaternions (x, y, z, w): z is the normal, x and y span the rectangle seen",
        default=None,
    )
    extents: F64 | None = array(
        "float64", "N 2", "full size of the rectangle seen, along its x and y", unit="m", default=None
    )
    hulls: F64 | None = array(
        "float64",
        "C 3",
        "corners of the convex hull of what was seen of each plane, plane after plane, counter-clockwise around n",
        unit="m",
        default=None,
    )
    hull_counts: I64 | None = array("int64", "N", "corners of each plane's hull", unit="corners", default=None)
    inlier_counts: I64 | None = array("int64", "N", "points of the cloud on each plane", unit="points", default=None)
    labels: I32 | None = array("int32", "P", "plane of each point of the cloud, -1 for none", default=None)

    def validate(self) -> None:
        count = len(self.coefficients)
        if count:
            unit_vectors(self, "coefficients", self.coefficients[:, :3])
        unit_quaternions(self, "orientations")
        together(self, "centers", "orientations", "extents")
        within(self, 0.0, float("inf"), "extents")
        together(self, "hulls", "hull_counts")
        if self.hulls is not None and self.hull_counts is not None:
            within(self, 0, len(self.hulls), "hull_counts")
            if int(self.hull_counts.sum()) != len(self.hulls):
                raise MessageError(
                    f"{self.SCHEMA}.hull_counts must add up to the {len(self.hulls)} corners of hulls, "
                    f"got {int(self.hull_counts.sum())}"
                )
        within_length(self, "labels", count, f"be -1 or index the {count} planes of coefficients", none=-1)

    @property
    def count(self) -> int:
        """Number of planes."""
        return len(self.coefficients)

    def hull(self, index: int) -> F64:
        """The corners (C, 3) of a plane's hull. Raises ValueError for a message without hulls."""
        if self.hulls is None or self.hull_counts is None:
            raise ValueError("these planes have no hulls")
        end = int(self.hull_counts[: index + 1].sum())
        return self.hulls[end - int(self.hull_counts[index]) : end]
