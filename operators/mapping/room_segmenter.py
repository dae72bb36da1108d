"""Rooms and doors of a floor plan as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Message, OccupancyGrid, Rooms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import transform_points
from dataflow.operator import Counts, In, Operator, Out, Param
from operators.mapping.rooms import Division, RoomSettings, divided, followed
from operators.status import counted_status


@dataclass(kw_only=True)
class State(Counts):
    """Holds the room of each cell of the last plan, by id, 0 for none, and where that plan lies."""

    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    place: tuple[str, float, list[float], list[float]] = ("", 0.0, [], [])
    fresh: int = 1
    stamp: int = -1
    doors: int = 0


class RoomSegmenter(Operator):
    """Divides the map of a floor into rooms, with the doors between them; rooms keep their ids while the map grows.

    A door is a passage between `narrowest` and `widest` that is narrower than the rooms on both sides of it; wider
    openings do not part rooms, and robots do not pass narrower ones. Unknown space is no wall: the shadow of a table
    does not part a room. Desks leave passages as narrow as doors, so the map should be of what stands higher than
    furniture (`OccupancyMapper` with `lower` at 1.2 m, say). Small things that stand free are left out anyway.

    Method: distance transform and watershed, as compared by Bormann et al., "Room segmentation: survey, implementation,
    and analysis", 2016.
    """

    map: In[OccupancyGrid] = In(doc="the floor: 0 free, 100 taken, -1 unknown")
    rooms: Out[Rooms] = Out(doc="rooms, by rising id, and doors, in the map's frame")
    status: Out[Diagnostics] = Out(doc="numbers of rooms and doors; a warning for a map without free floor")

    widest: float = Param(1.2, gt=0, doc="clear width up to which a passage may be a door: double doors are", unit="m")
    narrowest: float = Param(0.6, gt=0, doc="and from which: the narrowest that are built, as of a closet", unit="m")
    narrowing: float = Param(
        0.8, gt=0, lt=1, doc="a door is at most so wide as a share of the width of each of its rooms"
    )
    area: float = Param(1.5, ge=0, doc="smaller rooms are parts of the one behind their widest door", unit="m²")
    island: float = Param(1.0, ge=0, doc="what stands free and is shorter is no wall but a chair or a person", unit="m")
    period: float = Param(2.0, ge=0, doc="maps that come sooner after a division are passed over", unit="s")
    state: State

    def setup(self) -> None:
        """Raises ValueError for a narrowest door that is not below the widest."""
        if self.narrowest >= self.widest:
            raise ValueError(f"narrowest {self.narrowest} m must be below widest {self.widest} m")
        self._settings = RoomSettings(self.widest, self.narrowest, self.narrowing, self.area, self.island)

    def process(self, map: OccupancyGrid) -> dict[str, Message]:
        if self.state.stamp >= 0 and map.stamp - self.state.stamp < self.period * 1e9:
            self.state.counts["maps passed over"] += 1
            return {}
        self.state.stamp = map.stamp
        division = divided(map.cells, map.resolution, self._settings)
        ids, self.state.fresh = followed(division.labels, self._before(map), self.state.fresh)
        table = np.zeros(1 + max(ids, default=0), np.int64)
        for label, id in ids.items():
            table[label] = id
        self.state.ids = table[division.labels]
        made = _message(map, division, ids)
        self.state.counts["maps"] += 1
        self.state.doors = len(made.doors)
        free = bool((map.cells >= 0).any() and ids)
        text = f"{made.count} rooms, {len(made.doors)} doors" if free else "the map has no room: no free floor is known"
        counts = {"rooms": made.count, "doors": len(made.doors), "ids given": self.state.fresh - 1}
        level = Level.OK if free else Level.WARN
        return {"rooms": made, "status": counted_status("room_segmenter", map.stamp, text, level, counts)}

    def summary(self) -> Mapping[str, float | int]:
        rooms = np.unique(self.state.ids)
        return dict(self.state.counts) | {"rooms": int(np.count_nonzero(rooms)), "doors": self.state.doors}

    def _before(self, map: OccupancyGrid) -> NDArray[np.int64]:
        """Returns the rooms that the map's cells had, by id, and notes where the map lies."""
        height, width = map.cells.shape
        turn = [] if map.orientation is None else map.orientation.tolist()
        frame, resolution, corner, turned = self.state.place
        self.state.place = (map.frame, map.resolution, map.position.tolist(), turn)
        before = np.zeros((height, width), np.int64)
        if (frame, resolution, turned) != (map.frame, map.resolution, turn):
            return before
        away = map.matrix()[:3, :3].T @ (np.array(corner) - map.position)
        column, row = (round(v / resolution) for v in away[:2].tolist())
        rows = np.arange(max(row, 0), min(row + self.state.ids.shape[0], height))
        columns = np.arange(max(column, 0), min(column + self.state.ids.shape[1], width))
        before[np.ix_(rows, columns)] = self.state.ids[np.ix_(rows - row, columns - column)]
        return before


def _message(map: OccupancyGrid, division: Division, ids: Mapping[int, int]) -> Rooms:
    labels = sorted(ids, key=lambda label: ids[label])
    row = np.full(1 + max(labels, default=0), -1, np.int32)
    row[labels] = np.arange(len(labels))
    sizes = np.bincount(division.labels.ravel(), minlength=len(row))
    middles = [_widest(division, label) for label in labels]
    doors = sorted(division.doors, key=lambda d: (*sorted(row[list(d.rooms)].tolist()), d.row, d.column))
    places = [(d.row, d.column) for d in doors]
    return Rooms(
        stamp=map.stamp,
        frame=map.frame,
        resolution=map.resolution,
        cells=row[division.labels],
        position=map.position,
        orientation=map.orientation,
        ids=np.array([ids[label] for label in labels], np.int64),
        areas=sizes[np.array(labels, np.intp)].astype(np.float64) * map.resolution**2,
        centers=_placed(map, middles),
        doors=np.array([sorted(row[list(d.rooms)].tolist()) for d in doors], np.int32).reshape(-1, 2),
        door_positions=_placed(map, places),
        door_widths=np.array([d.width for d in doors], np.float64),
    )


def _widest(division: Division, label: int) -> tuple[int, int]:
    """Returns the cell of a room that is farthest from its walls; of equals that which is nearest to their middle."""
    rows, columns = np.nonzero(division.labels == label)
    widths = division.widths[rows, columns]
    best = np.flatnonzero(widths >= widths.max() - 1e-6)
    away = np.hypot(rows[best] - rows[best].mean(), columns[best] - columns[best].mean())
    chosen = best[int(np.argmin(away))]
    return int(rows[chosen]), int(columns[chosen])


def _placed(map: OccupancyGrid, cells: list[tuple[int, int]]) -> NDArray[np.float64]:
    """Returns the middles (N, 3) of cells in the map's frame."""
    flat = (np.array(cells, np.float64).reshape(-1, 2)[:, ::-1] + 0.5) * map.resolution
    return transform_points(map.matrix(), np.column_stack([flat, np.zeros(len(flat))]))
