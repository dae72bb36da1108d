"""A map of small planes in the voxels of a few grids, grown scan by scan.

Yuan et al., "Efficient and probabilistic adaptive voxel mapping for accurate online LiDAR odometry", 2022, with grids
of halving size instead of trees. A plane comes from the moments of all points in a voxel, so scan lines that move with
the sensor do not pull a pose towards rest, as they pull methods that pair points.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.odometry.lidar.beams import cross, passed_through

Array = NDArray[np.float64]
Keys = NDArray[np.int64]
Rows = NDArray[np.intp]

FEWEST = 8  # points of a plane
ENOUGH = 200  # points after which a voxel's plane stays as it is
FLAT = 0.03  # a plane is thinner (one standard deviation) than this share of its voxel, plus a centimetre,
WIDE = 0.12  # and wider, in its narrower direction; one scan line across a voxel is not
_NOISE = 0.02  # metres, of a point, in what is said of a normal
_AGAIN = 1.2  # a plane is fitted again when its points have grown by this factor
_OFFSET = 1 << 20  # cells along one axis on either side of the origin
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_HASH = np.array([73856093, 19349663, 83492791], np.uint32)
_SLOTS = 1 << 20


class _Slots(threading.local):
    """Numbers (_SLOTS,) of each thread, which are written before they are read: the memory of new ones would have to be
    cleared by the kernel at each use."""

    def __init__(self) -> None:
        self.numbers = np.empty(_SLOTS, np.int32)


_slots = _Slots()


def thinned(points: NDArray[np.floating[Any]], size: float) -> Rows:
    """Returns the indices of the first point (N, 3) in each cube of a grid.

    One to four in a hundred are lost where two cubes have one hash: an exact key, sorted, takes three to five times as
    long (1.7 to 3.3 ms of a turn of 114,000 points, for 0.6).
    """
    voxel = points * points.dtype.type(1 / size)
    voxel = np.floor(voxel, out=voxel).astype(np.int32).view(np.uint32)
    slot = (voxel[:, 0] * _HASH[0] ^ voxel[:, 1] * _HASH[1] ^ voxel[:, 2] * _HASH[2]) & np.uint32(_SLOTS - 1)
    slot = slot.astype(np.intp)
    first = _slots.numbers
    number = np.arange(len(points), dtype=np.int32)
    first[slot[::-1]] = number[::-1]
    return np.flatnonzero(first.take(slot) == number)


def _spread_bits(voxel: Keys) -> Keys:
    """Returns 21-bit numbers with two zero bits before each bit."""
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        voxel = (voxel | (voxel << shift)) & mask
    return voxel


def _voxels(points: Array, size: float) -> Keys:
    """Returns the voxel (3, N) of every point in a grid that it must lie in, counted from a far corner."""
    return np.floor(points.T * (1.0 / size)).astype(np.int64) + _OFFSET


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points and the planes in whose voxels they lie.

    `points` (M,) are indices; `centers` and `normals` (M, 3) in the map's frame; `thickness` (M,) is the variance of
    the plane's points about it, m²; `slopes` (M,) that of the normal's direction, rad²; `births` (M,) is when the plane
    was first seen, as given to `add`; `known` is the share of all points in voxels that hold enough points.
    """

    points: Rows
    centers: Array
    normals: Array
    thickness: Array
    slopes: Array
    births: NDArray[np.int64]
    known: float


class _Rows(Remembered):
    """Voxels of one size, in the order in which they came."""

    moments: Array  # (N, 10): n, sum of x (3), sum of xx' (6), about the centre of the largest voxel
    planes: Array  # (N, 9): centre (3), normal (3), thickness, slope, whether it is one
    fitted: Array  # (N,) points of which the plane was made
    births: NDArray[np.int64]  # (N,)

    def __init__(self, size: float) -> None:
        self.size, self.thickest = size, FLAT * size + 0.01
        self.count = 0
        self.moments, self.planes = np.zeros((1024, 10)), np.zeros((1024, 9))
        self.fitted, self.births = np.zeros(1024), np.zeros(1024, np.int64)

    def prepare_snapshot(self) -> None:
        for name in _ROWS:
            setattr(self, name, getattr(self, name)[: self.count])

    def restored(self) -> None:
        self.count = len(self.fitted)

    def grow(self, more: int, birth: int) -> Rows:
        """Returns new rows."""
        rows = np.arange(self.count, self.count + more)
        self.count += more
        if self.count > len(self.fitted):
            room = max(self.count, 2 * len(self.fitted)) - len(self.fitted)
            for name in _ROWS:
                values = getattr(self, name)
                setattr(self, name, np.concatenate([values, np.zeros((room, *values.shape[1:]), values.dtype)]))
        self.births[rows] = birth
        return rows

    def take(self, moments: Array, rows: Rows, centers: Array, birth: int) -> tuple[Rows, Array]:
        """Adds moments (V, 10) about `centers` (V, 3) to rows that have not enough points, and fits their planes.

        A plane is as old as the first of its fits that was one. Returns the rows of planes that are new, and the
        covariances (N, 3, 3) of their points.
        """
        wanting = np.flatnonzero(self.moments[rows, 0] < ENOUGH)
        rows = rows[wanting]
        moments = self.moments.take(rows, axis=0) + moments.take(wanting, axis=0)
        self.moments[rows] = moments
        fit = np.flatnonzero((moments[:, 0] >= FEWEST) & (moments[:, 0] >= _AGAIN * self.fitted[rows]))
        rows, moments, wanting = rows[fit], moments.take(fit, axis=0), wanting[fit]
        mean = moments[:, 1:4] / moments[:, :1]
        spread = np.empty((len(rows), 3, 3))
        for k, (i, j) in enumerate(_PAIRS):
            spread[:, i, j] = spread[:, j, i] = moments[:, 4 + k] / moments[:, 0] - mean[:, i] * mean[:, j]
        normals, thin, narrow = _thinnest(spread)
        planes = np.empty((len(rows), 9))
        planes[:, :3] = mean + centers[wanting]
        planes[:, 3:6] = normals
        planes[:, 6] = thin
        planes[:, 7] = (thin + _NOISE**2) / (moments[:, 0] * np.maximum(narrow, 1e-9))
        planes[:, 8] = (thin < self.thickest**2) & (narrow > (WIDE * self.size) ** 2)
        new = np.flatnonzero((planes[:, 8] > 0) & (self.planes[rows, 8] == 0))
        self.births[rows[new]] = birth
        self.planes[rows] = planes
        self.fitted[rows] = moments[:, 0]
        return rows[new], spread[new]

    def keep(self, kept: Rows) -> None:
        """Forgets all other rows."""
        for name in _ROWS:
            setattr(self, name, getattr(self, name)[kept])
        self.count = len(kept)


_ROWS = ("moments", "planes", "fitted", "births")


class PlaneMap(Remembered):
    """Planes in voxels of `size`, and of half, a quarter ... of it. A point belongs to the largest plane there.

    The largest voxels, the blocks, are found through their sorted keys, the others through a table in each block, both
    by Morton codes: the code of a voxel is that of its block and three more bits for each halving.
    """

    _keys: Keys
    _order: Rows  # the block of each key
    _corners: Array  # (B, 3) centre of each block
    _tables: list[NDArray[np.int32]]  # (B, 8**k) row of each voxel of a block, or -1
    _rows: list[_Rows]

    def __init__(self, size: float, levels: int) -> None:
        self._size, self._levels = size, levels
        self._keys, self._order = np.zeros(0, np.int64), np.zeros(0, np.intp)
        self._corners = np.zeros((0, 3))
        self._tables = [np.zeros((0, 8**k), np.int32) for k in range(levels)]
        self._rows = [_Rows(size / 2**k) for k in range(levels)]

    def __len__(self) -> int:
        return sum(rows.count for rows in self._rows)

    def add(self, points: Array, birth: int, seen_from: Array | None = None) -> None:
        """Takes points (N, 3) in the map's frame; voxels and planes that they open are marked with `birth`.

        No beam passes through a plane that is `seen_from` a place (3,).
        """
        if not len(points):
            return
        voxel = _voxels(points, self._size / 2 ** (self._levels - 1))
        code = _spread_bits(voxel[0]) << 2 | _spread_bits(voxel[1]) << 1 | _spread_bits(voxel[2])
        order = np.argsort(code, kind="stable")
        code, down = code[order], 3 * (self._levels - 1)
        ordered, fresh = points.take(order, axis=0), []
        block_of = self._blocks_of(code >> down, ordered)
        d = ordered - self._corners.take(block_of, axis=0)
        moments = np.empty((len(points), 10))
        moments[:, 0] = 1
        moments[:, 1:4] = d
        for k, (i, j) in enumerate(_PAIRS):
            np.multiply(d[:, i], d[:, j], out=moments[:, 4 + k])
        for k in reversed(range(self._levels)):  # from the smallest: the moments of larger ones are sums
            first = _firsts(code)
            code, moments, block_of = code[first], np.add.reduceat(moments, first, axis=0), block_of[first]
            inside = code & (8**k - 1)
            rows = self._tables[k][block_of, inside].astype(np.intp)
            new = np.flatnonzero(rows < 0)
            rows[new] = self._rows[k].grow(len(new), birth)
            self._tables[k][block_of[new], inside[new]] = rows[new]
            fresh.append((self._rows[k], *self._rows[k].take(moments, rows, self._corners[block_of], birth)))
            code = code >> 3
        if seen_from is not None:
            _leave_out_passed(fresh, points, seen_from)

    def pairs(self, points: Array) -> Pairs:
        """Returns the planes that points (N, 3) in the map's frame belong to."""
        finest = self._levels - 1
        voxel = _voxels(points, self._size / 2**finest)
        block_of = self._find(voxel >> finest)
        plane = np.zeros((len(points), 9))
        births = np.zeros(len(points), np.int64)
        known = np.zeros(len(points), np.bool_)
        todo = np.flatnonzero(block_of >= 0)
        for k, level in enumerate(self._rows):
            inside = np.zeros(len(todo), np.int64)
            for bit in range(k):
                part = (voxel[:, todo] >> (finest - k + bit)) & 1
                inside |= (part[0] << 2 | part[1] << 1 | part[2]) << (3 * bit)
            rows = self._tables[k][block_of[todo], inside]
            there = rows >= 0
            todo, rows = todo[there], rows[there]
            known[todo] |= level.moments[rows, 0] >= FEWEST
            found = level.planes[rows, 8] > 0
            plane[todo[found]], births[todo[found]] = level.planes.take(rows[found], axis=0), level.births[rows[found]]
            todo = todo[~found]
        paired = np.flatnonzero(plane[:, 8])
        share = float(known.mean()) if len(known) else 0.0
        own = plane.take(paired, axis=0)
        return Pairs(paired, own[:, :3], own[:, 3:6], own[:, 6], own[:, 7], births[paired], share)

    def keep(self, near: Array, reach: float) -> None:
        """Forgets the blocks that are farther than `reach` from a place (3,)."""
        d = self._corners - near
        kept = np.einsum("ij,ij->i", d, d) <= reach * reach
        mine = kept[self._order]
        self._keys, self._order = self._keys[mine], (np.cumsum(kept) - 1)[self._order[mine]]
        self._corners = self._corners[kept]
        for k, level in enumerate(self._rows):
            table = self._tables[k][kept]
            there = table >= 0
            rows = table[there]
            table[there] = np.arange(len(rows), dtype=np.int32)
            self._tables[k] = table
            level.keep(rows.astype(np.intp))

    def _find(self, voxel: Keys) -> Rows:
        """Returns the block of each voxel (3, N) of the largest voxels, -1 where there is none."""
        if not len(self._keys):
            return np.full(voxel.shape[1], -1, np.intp)
        code = _spread_bits(voxel[0]) << 2 | _spread_bits(voxel[1]) << 1 | _spread_bits(voxel[2])
        at = np.searchsorted(self._keys, code)
        at[at == len(self._keys)] = 0
        return np.where(self._keys[at] == code, self._order[at], -1)

    def _blocks_of(self, code: Keys, points: Array) -> Rows:
        """Returns the block of each code, sorted; makes those that are new."""
        first = _firsts(code)
        own = code[first]
        at = np.searchsorted(self._keys, own)
        there = at < len(self._keys)
        there[there] = self._keys[at[there]] == own[there]
        new = np.flatnonzero(~there)
        fresh = np.arange(len(self._corners), len(self._corners) + len(new))
        blocks = np.empty(len(own), np.intp)
        blocks[there] = self._order[at[there]]
        blocks[new] = fresh
        self._keys = np.insert(self._keys, at[new], own[new])
        self._order = np.insert(self._order, at[new], fresh)
        corners = (np.floor(points[first[new]] / self._size) + 0.5) * self._size
        self._corners = np.concatenate([self._corners, corners])
        for k, table in enumerate(self._tables):
            self._tables[k] = np.concatenate([table, np.full((len(new), 8**k), -1, np.int32)])
        return np.repeat(blocks, np.diff(np.append(first, len(code))))


def _leave_out_passed(fresh: list[tuple[_Rows, Rows, Array]], points: Array, origin: Array) -> None:
    """Takes new planes, of rows with their points' covariances, for none where a beam from `origin` passed through."""
    planes = np.concatenate([level.planes[rows] for level, rows, _ in fresh])
    spread = np.concatenate([own for _, _, own in fresh])
    counts = [len(rows) for _, rows, _ in fresh]
    thickest = np.repeat([level.thickest for level, _, _ in fresh], counts)
    passed = passed_through(points, origin, planes[:, :3], planes[:, 3:6], spread, thickest)
    for (level, rows, _), own in zip(fresh, np.split(passed, np.cumsum(counts)[:-1]), strict=True):
        level.planes[rows[own], 8] = 0


def _firsts(code: Keys) -> Rows:
    """Returns where each run of equal codes begins."""
    return np.flatnonzero(np.append(True, code[1:] != code[:-1]))


def _thinnest(spread: Array) -> tuple[Array, Array, Array]:
    """Returns the direction (N, 3) of least variance of symmetric (N, 3, 3), that variance, and the next larger one.

    Closed form: O. K. Smith, "Eigenvalues of a symmetric 3 × 3 matrix", 1961.
    """
    mean = np.trace(spread, axis1=1, axis2=2) / 3
    centred = spread - mean[:, None, None] * np.eye(3)
    scale = np.sqrt(np.maximum(np.einsum("nij,nij->n", centred, centred) / 6, 1e-30))
    (a, d, f), (b, e), c = centred[:, 0].T, centred[:, 1, 1:].T, centred[:, 2, 2]
    det = a * (b * c - e * e) - d * (d * c - e * f) + f * (d * e - b * f)
    angle = np.arccos(np.clip(det / (2 * scale**3), -1, 1)) / 3
    largest = mean + 2 * scale * np.cos(angle)
    least = mean + 2 * scale * np.cos(angle + 2 * np.pi / 3)
    rest = spread - least[:, None, None] * np.eye(3)
    products = np.stack([cross(rest[:, i], rest[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))], axis=1)
    square = np.einsum("nki,nki->nk", products, products)
    own = np.arange(len(spread))
    best = square.argmax(axis=1)
    normals = products[own, best] / np.sqrt(np.maximum(square[own, best], 1e-60))[:, None]
    return normals, np.maximum(least, 0.0), 3 * mean - least - largest
