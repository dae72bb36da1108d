"""Occupancy of columns of the floor, by height, from rays that end on surfaces and pass through what is free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered

Array = NDArray[np.float64]
Points = NDArray[np.float32]
Cubes = NDArray[np.int32]

_BLOCK = 64  # columns by which the grid grows
_STEP = 0.75  # cells between the samples of a ray


@dataclass(frozen=True)
class GridSettings:
    """Lengths in metres. `hit` and `miss` are added log-odds, which stay within ±`bound`.

    `layer` is the height of a slice, as near as whole slices fill the band. `band` holds the heights that matter,
    `growth` (1/m) times the squared range is how far above the band's lower end a surface must lie to be no noisy
    floor, `near` and `far` bound the ranges; farther rays show what they pass.
    """

    resolution: float
    layer: float
    band: tuple[float, float]
    growth: float
    near: float
    far: float
    hit: float
    miss: float
    bound: float
    most_cubes: int


class ColumnGrid(Remembered):
    """Log-odds of occupancy in cubes of the map frame: columns over the cells of the floor, cut into slices.

    A ray over a table does not observe the table, so heights are kept apart until the grid is asked for its plan. Cubes
    that no ray has met are NaN. Moravec and Elfes, "High resolution maps from wide angle sonar", 1985; bounds and one
    change per cube and scan as in Hornung et al., "OctoMap", 2013.
    """

    _corner: Cubes
    _odds: NDArray[np.float32]

    def __init__(self, settings: GridSettings) -> None:
        self._settings = settings
        low, high = settings.band
        self._slices = max(1, round((high - low) / settings.layer))
        self._corner = np.zeros(2, np.int32)  # column and row of the first cell, in cells from the origin
        self._odds = np.zeros((self._slices, 0, 0), np.float32)

    def insert(self, origin: Array, points: Array) -> int:
        """Takes points (N, 3) that the sensor at `origin` (3,) saw, in the map frame; returns how many were usable.

        Raises ValueError where the grid would have more than `most_cubes` cubes.
        """
        s = self._settings
        usual = points.astype(np.float32)
        off = usual - origin.astype(np.float32)
        distance = np.sqrt(np.einsum("ij,ij->i", off, off))
        usable = distance >= s.near  # false for NaN, too
        usable &= distance < np.inf
        off, distance, usual = off[usable], distance[usable], usual[usable]
        if not len(usual):
            return 0
        low, high = s.band
        z = usual[:, 2]
        solid = (distance <= s.far) & (z >= low + s.growth * distance**2) & (z < high)
        hits = self._cubes(usual[solid].T)
        misses = self._cubes(_samples(origin, off, distance, s))
        if not hits.size + misses.size:
            return len(usual)
        self._grow(np.concatenate([hits[:2], misses[:2]], axis=1))
        hit, free = self._marked(hits), self._marked(misses)
        free &= ~hit
        odds = self._odds.reshape(-1)
        for chosen, change in ((hit, s.hit), (free, -s.miss)):
            where = np.flatnonzero(chosen)
            odds[where] = np.clip(np.nan_to_num(odds[where]) + np.float32(change), -s.bound, s.bound)
        return len(usual)

    def plan(self) -> tuple[NDArray[np.int8], Array]:
        """Returns the cells (H, W), 0 free to 100 occupied and -1 unknown, and the corner (2,) of the first, metres.

        A cell is as full as the fullest slice that was seen of its column.
        """
        seen = ~np.isnan(self._odds)
        fullest = np.where(seen, self._odds, -np.inf).max(axis=0, initial=-np.inf)
        known = np.isfinite(fullest)
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        if not len(rows):
            return np.zeros((0, 0), np.int8), np.zeros(2)
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        share = 100 / (1 + np.exp(-np.where(known, fullest, 0.0)[window].astype(np.float64)))
        cells = np.where(known[window], np.rint(share), -1).astype(np.int8)
        return cells, (self._corner + np.array([columns[0], rows[0]])) * self._settings.resolution

    def _cubes(self, points: Points) -> Cubes:
        """Returns column, row and slice (3, N) of points (3, N) within the band."""
        size = self._settings.resolution
        low, high = (np.float32(height) for height in self._settings.band)
        cubes = np.empty(points.shape, np.int32)
        np.floor(points[:2] * np.float32(1 / size), out=cubes[:2], casting="unsafe")
        np.multiply(points[2] - low, self._slices / (high - low), out=cubes[2], casting="unsafe")
        np.clip(cubes[2], 0, self._slices - 1, out=cubes[2])
        return cubes

    def _marked(self, cubes: Cubes) -> NDArray[np.bool_]:
        """Returns which cubes of the grid are among these, flat."""
        _, height, width = self._odds.shape
        marked = np.zeros(self._odds.size, np.bool_)
        marked[(cubes[2] * height + (cubes[1] - self._corner[1])) * width + (cubes[0] - self._corner[0])] = True
        return marked

    def _grow(self, columns: Cubes) -> None:
        """Makes room for columns (2, N), in blocks."""
        height, width = self._odds.shape[1:]
        size = np.array([width, height])
        low, high = columns.min(axis=1), columns.max(axis=1) + 1
        if self._odds.size:
            low, high = np.minimum(low, self._corner), np.maximum(high, self._corner + size)
            if (low == self._corner).all() and (high == self._corner + size).all():
                return
        low, high = low // _BLOCK * _BLOCK, -(-high // _BLOCK) * _BLOCK
        wide, tall = (int(n) for n in high - low)
        if self._slices * wide * tall > self._settings.most_cubes:
            raise ValueError(
                f"the map would reach {wide * self._settings.resolution:.0f} x "
                f"{tall * self._settings.resolution:.0f} m: more than {self._settings.most_cubes} cubes"
            )
        grown = np.full((self._slices, tall, wide), np.nan, np.float32)
        if self._odds.size:
            x, y = self._corner - low
            grown[:, y : y + height, x : x + width] = self._odds
        self._odds, self._corner = grown, low


def _samples(origin: Array, off: Points, distance: Points, s: GridSettings) -> Points:
    """Returns points (3, M) along the parts of rays that lie within the band and a cell before their ends."""
    direction = off / distance[:, None]
    step = _STEP * s.resolution
    end = np.minimum(distance - s.resolution, s.far)
    rise = direction[:, 2]
    level = np.abs(rise) < 1e-6
    crossings = (np.array(s.band, np.float32)[:, None] - np.float32(origin[2])) / np.where(level, 1, rise)
    inside = s.band[0] <= origin[2] < s.band[1]
    begin = np.where(level, 0 if inside else np.inf, crossings.min(axis=0))
    begin = np.maximum(begin, s.near)
    end = np.where(level, end, np.minimum(end, crossings.max(axis=0) - 1e-4))
    counts = np.maximum(0, np.ceil((end - begin) / step)).astype(np.int32)
    number = np.arange(counts.sum(), dtype=np.int32) - np.repeat(np.cumsum(counts) - counts, counts)
    along = number.astype(np.float32) * np.float32(step) + np.repeat(begin.astype(np.float32), counts)
    samples = np.empty((3, len(along)), np.float32)
    for axis in range(3):
        np.multiply(np.repeat(direction[:, axis], counts), along, out=samples[axis])
        samples[axis] += np.float32(origin[axis])
    return samples
