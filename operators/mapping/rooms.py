"""Rooms and doors in the plan of a floor: the free floor is cut where walls leave a narrow passage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

Labels = NDArray[np.uint16]
Mask = NDArray[np.bool_]

TAKEN = 50
"""Percent from which a cell is taken."""

_GAP = 0.1  # metres by which cells of one wall may be apart: scans of it have gaps
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class RoomSettings:
    """Lengths in metres, areas in square metres.

    Passages between `narrowest` and `widest` may be doors; one is where it is at most `narrowing` times as wide as both
    rooms. Smaller rooms than `area` are parts of others. Free-standing things shorter than `island` are no walls.
    """

    widest: float = 1.2
    narrowest: float = 0.6
    narrowing: float = 0.8
    area: float = 1.5
    island: float = 1.0


@dataclass(frozen=True)
class Door:
    """A passage of some width, metres, between two labels, the lower one first, and the cell in its middle."""

    rooms: tuple[int, int]
    row: int
    column: int
    width: float


@dataclass(frozen=True, eq=False)
class Division:
    """Labels (H, W) of the rooms, from 1 on, 0 for what is none, and the widest empty circle (H, W) around each cell,
    metres across, with the doors."""

    labels: Labels
    widths: NDArray[np.float32]
    doors: tuple[Door, ...]


def divided(cells: NDArray[np.int8], resolution: float, settings: RoomSettings) -> Division:
    """Divides a plan (H, W), 0 free to 100 taken and -1 unknown, into rooms and the doors between them.

    Rooms are flooded from where they are widest; where two meet in a passage that may be a door they stay apart, else
    they are one (watershed by the distance transform, with the passage's width in the place of depth). Unknown space is
    no wall: it neither narrows a passage nor parts the floor, as far as walls and a door's width allow. After Bormann
    et al., "Room segmentation: survey, implementation, and analysis", 2016, and Meyer, "Topographic distance and
    watershed lines", 1994.
    """
    if not (cells >= 0).any():
        return Division(np.zeros(cells.shape, np.uint16), np.zeros(cells.shape, np.float32), ())
    walls = _walls(cells >= TAKEN, resolution, settings.island)
    floor = (cells >= 0) & ~walls
    widths = _widths(walls, resolution)
    passable = _bridged(floor, walls, settings.widest / resolution)
    labels = _flooded(passable, widths, resolution, settings)
    doors = _doors(labels, widths, settings)
    labels, doors = _without_small(labels, floor, doors, settings.area / resolution**2)
    return Division(np.where(floor, labels, 0).astype(np.uint16), widths, tuple(doors))


def _walls(taken: Mask, resolution: float, island: float) -> Mask:
    """Returns the taken cells without what stands free and is small: chairs, people, plants, posts."""
    reach = max(1, round(_GAP / resolution))
    side = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    joined = cv2.dilate(taken.astype(np.uint8), side)
    _, parts, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    longest = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) - 2 * reach
    small = longest * resolution < island
    small[0] = False
    return np.asarray(taken & ~small[parts])


def _widths(walls: Mask, resolution: float) -> NDArray[np.float32]:
    """Returns how wide a circle around each cell meets no wall; beyond the grid there is none.

    Walls begin in the middle of the taken cells at their edge: a surface lies anywhere in the cell that it takes.
    """
    if not walls.any():
        return np.full(walls.shape, np.inf, np.float32)
    height, width = walls.shape
    halves = np.repeat(np.repeat(~walls, 2, axis=0), 2, axis=1)  # the middle of an even number of cells is between two
    away = cv2.distanceTransform(halves.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    most = away.reshape(height, 2, width, 2).max(axis=(1, 3))
    return np.asarray((most + 1) * np.float32(resolution), np.float32)


def _bridged(floor: Mask, walls: Mask, cells: float) -> Mask:
    """Returns the floor with the gaps in it that are less than so many cells wide and no walls."""
    reach = max(1, int(cells / 2))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    padded = cv2.copyMakeBorder(floor.astype(np.uint8), reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk)[reach:-reach, reach:-reach]
    return np.asarray((closed > 0) & ~walls)


def _flooded(passable: Mask, widths: NDArray[np.float32], resolution: float, settings: RoomSettings) -> Labels:
    """Returns the rooms that floods from the widest places give, down to the narrowest passage that may be a door."""
    labels = np.zeros(passable.shape, np.uint16)
    peaks: dict[int, float] = {}
    apart: set[tuple[int, int]] = set()
    for level in np.arange(settings.widest, settings.narrowest - resolution / 2, -resolution).tolist():
        mask = passable & (widths >= level)
        _spread(labels, mask)
        while met := sorted(_touching(labels) - apart):
            a, b = met[0]
            if level <= settings.narrowing * min(peaks[a], peaks[b]):
                apart.add((a, b))
                continue
            kept, gone = (a, b) if peaks[a] >= peaks[b] else (b, a)
            labels[labels == gone] = kept
            del peaks[gone]
            apart = {_ordered(*(kept if room == gone else room for room in pair)) for pair in apart}
        count, parts = cv2.connectedComponents((mask & (labels == 0)).astype(np.uint8), connectivity=8)
        for part in range(1, count):
            own = parts == part
            number = 1 + max(peaks, default=0)
            labels[own], peaks[number] = number, float(widths[own].max())
    _spread(labels, passable)
    return labels


def _ordered(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)


def _spread(labels: Labels, mask: Mask) -> None:
    """Lets labels grow into the cells of a mask that have none, as far as they go; of two that meet, the higher."""
    while True:
        grown = cv2.dilate(labels, _NEIGHBOURS)
        new = mask & (labels == 0) & (grown > 0)
        if not new.any():
            return
        labels[new] = grown[new]


_SHIFTS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns from a cell to half of its neighbours."""


def _beside(labels: Labels) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Returns windows on a grid whose cells are neighbours, for each direction."""
    height, width = labels.shape
    for down, right in _SHIFTS:
        first = slice(0, height - down), slice(max(0, -right), width - max(0, right))
        last = slice(down, height), slice(max(0, right), width - max(0, -right))
        yield first, last


def _touching(labels: Labels) -> set[tuple[int, int]]:
    """Returns the pairs of labels, the lower one first, of which cells are neighbours."""
    found: set[tuple[int, int]] = set()
    for first, last in _beside(labels):
        a, b = labels[first], labels[last]
        differ = (a != b) & (a > 0) & (b > 0)
        low, high = np.minimum(a, b)[differ], np.maximum(a, b)[differ]
        found |= set(zip(low.tolist(), high.tolist(), strict=True))
    return found


def _doors(labels: Labels, widths: NDArray[np.float32], settings: RoomSettings) -> list[Door]:
    """Returns the passages between rooms that are wide enough, each where it is widest along the line between them."""
    doors = []
    for a, b in sorted(_touching(labels)):
        line = np.zeros(labels.shape, np.uint8)
        for first, last in _beside(labels):
            one, two = labels[first], labels[last]
            meet = ((one == a) & (two == b)) | ((one == b) & (two == a))
            line[first] |= meet
            line[last] |= meet
        count, parts = cv2.connectedComponents(line, connectivity=8)
        for part in range(1, count):
            own = parts == part
            width = float(widths[own].max())
            if width >= settings.narrowest:
                rows, columns = np.nonzero(own & (widths >= width - 1e-6))
                middle = int(np.argmin(np.hypot(rows - rows.mean(), columns - columns.mean())))
                doors.append(Door((a, b), int(rows[middle]), int(columns[middle]), width))
    return doors


def _without_small(labels: Labels, floor: Mask, doors: Sequence[Door], cells: float) -> tuple[Labels, list[Door]]:
    """Returns the rooms without those of fewer cells, which become parts of the room behind their widest door."""
    left, kept = labels.copy(), list(doors)
    while True:
        sizes = np.bincount(left[floor].ravel())
        small = [int(k) for k in np.flatnonzero((sizes > 0) & (sizes < cells)) if k > 0]
        if not small:
            return left, kept
        room = min(small, key=lambda k: (int(sizes[k]), k))
        ways = [d for d in kept if room in d.rooms]
        into = 0
        if ways:
            widest = max(ways, key=lambda d: (d.width, -d.row, -d.column))
            into = next(r for r in widest.rooms if r != room)
        left[left == room] = into
        renamed = [replace(d, rooms=_ordered(*(into if r == room else r for r in d.rooms))) for d in kept]
        kept = [d for d in renamed if 0 < d.rooms[0] < d.rooms[1]]


def followed(labels: Labels, before: NDArray[np.int64], fresh: int) -> tuple[dict[int, int], int]:
    """Returns the id of each label, and the next id that was never given.

    `before` (H, W) has the ids that cells had, 0 for none: a room keeps the id with which it shares most cells, each
    once.
    """
    both = (labels > 0) & (before > 0)
    pairs, counts = np.unique(np.stack([labels[both].astype(np.int64), before[both]]), axis=1, return_counts=True)
    shares = sorted(zip((-counts).tolist(), pairs[1].tolist(), pairs[0].tolist(), strict=True))
    ids: dict[int, int] = {}
    for _, id, label in shares:
        if label not in ids and id not in ids.values():
            ids[label] = id
    for label in [int(k) for k in np.unique(labels) if k > 0 and int(k) not in ids]:
        ids[label], fresh = fresh, fresh + 1
    return ids, fresh
