"""Rooms of a floor as nodes of the scene graph: their boxes, doors between them, and the room that a place is in."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Rooms
from dataflow.messages.geometry import invert, transform_points
from dataflow.messages.scene_summary import ROOMS
from operators.scene.bodies import Body
from operators.scene.relations import FLOOR, ROBOT, Relation

Array = NDArray[np.float64]

BESIDE = 0.5
"""Metres from the floor of a room up to which what stands there is in it: walls and what was not seen before them."""


class RoomPlan:
    """Rooms as a message gives them. `areas` (m²) are theirs by the id of their node."""

    def __init__(self, rooms: Rooms) -> None:
        self.stamp, self.frame = rooms.stamp, rooms.frame
        self._side, self._T_grid_frame = rooms.resolution, invert(rooms.matrix())
        self._ids = [ROOMS - int(i) for i in rooms.ids]
        self._cells, self._corners = rooms.cells, self._ends(rooms)
        self.areas = dict(zip(self._ids, rooms.areas.tolist(), strict=True))
        self._doors = sorted({(self._ids[a], self._ids[b]) for a, b in rooms.doors.tolist()}, reverse=True)
        self._nearest: tuple[NDArray[np.float32], NDArray[np.int32]] | None = None

    def bodies(self, ground: float, height: float) -> list[Body]:
        """Returns the rooms as upright boxes along the axes of the frame, from the ground (m) up to a height."""
        made = []
        for id, (low, high) in zip(self._ids, self._corners, strict=True):
            center = np.array([*(low + high) / 2, (ground + height) / 2])
            made.append(Body(id, "room", center, np.array([*(high - low), height - ground]), 0.0, np.zeros(3)))
        return made

    def relations(self, bodies: list[Body]) -> dict[Relation, float]:
        """Returns which of the bodies, agents and robot among them, is in which room, and which rooms doors join."""
        found: dict[Relation, float] = {(a, "connected_to", b): 1.0 for a, b in self._doors}
        for body in bodies:
            if body.id > FLOOR or body.id == ROBOT:
                room = self.room_at(body.center, body.flat_radius)
                if room is not None:
                    found[body.id, "in", room] = 1.0
        return found

    def room_at(self, place: Array, radius: float = 0.0) -> int | None:
        """Returns the node of the room whose floor is nearest to what stands at a place (3,) and is so large, metres.

        None where none is near.
        """
        if not self._ids:
            return None
        x, y = (transform_points(self._T_grid_frame, place[None])[0, :2] / self._side).tolist()
        height, width = self._cells.shape
        row, column = min(max(int(np.floor(y)), 0), height - 1), min(max(int(np.floor(x)), 0), width - 1)
        beyond = float(np.hypot(y - (row + 0.5), x - (column + 0.5))) - 1
        away, own = self._nearest_rooms()
        if (float(away[row, column]) + max(beyond, 0.0)) * self._side > radius + BESIDE:
            return None
        return self._ids[int(own[row, column])]

    def _nearest_rooms(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Returns how far from each cell the nearest floor of a room is, in cells, and the index of that room."""
        if self._nearest is None:
            none = (self._cells < 0).astype(np.uint8)
            away, labels = cv2.distanceTransformWithLabels(none, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
            table = np.zeros(int(labels.max()) + 1, np.int32)
            table[labels[none == 0]] = self._cells[none == 0]
            self._nearest = away.astype(np.float32), table[labels]
        return self._nearest

    def _ends(self, rooms: Rooms) -> list[tuple[Array, Array]]:
        """Returns the least and greatest x and y (2,) of each room in its frame."""
        ends = []
        for k in range(rooms.count):
            rows, columns = np.nonzero(rooms.cells == k)
            if not len(rows):
                ends.append((rooms.centers[k, :2], rooms.centers[k, :2]))
                continue
            flat = np.stack([columns, rows], axis=1) + 0.5
            places = np.column_stack([flat * rooms.resolution, np.zeros(len(flat))])
            placed = transform_points(rooms.matrix(), places)[:, :2]
            ends.append((placed.min(axis=0) - rooms.resolution / 2, placed.max(axis=0) + rooms.resolution / 2))
        return ends
