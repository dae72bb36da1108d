"""Voxels of one object in the world: where it was seen, how often, and where it was seen through."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from operators.scene.map.trajectory import Correction

Array = NDArray[np.float64]
Keys = NDArray[np.int64]

_HALF = 1 << 20
_FEW = 4096  # pairs of places
_LEAST = 20  # voxels that show where a thing is
_COLUMNS = ("points", "hits", "free", "other", "times")
_WEIGHTS = np.array([1 << 42, 1 << 21, 1], np.int64)


def keys_of(points: Array, side: float) -> Keys:
    """Returns the voxel (N,) of each point (N, 3), for places within 2**20 voxels of the origin."""
    cell = np.clip(np.floor(points / side), -_HALF, _HALF - 1).astype(np.int64)
    return np.asarray((cell + _HALF) @ _WEIGHTS)


class VoxelSet:
    """A set of voxels with the mean of the points in each, and counts of views.

    `hits` are the views in which it was the object's, `other` those in which the object was seen and this surface too,
    as something else, `free` those that saw through it; `times` are the mean times of the hits, nanoseconds.
    """

    def __init__(self, side: float, keys: Keys | None = None, points: Array | None = None, stamp: int = 0) -> None:
        """Takes the voxels of one view by rising key, and the means (N, 3) of the points in each; none without."""
        self.side = side
        self.points: Array = np.zeros((0, 3)) if points is None else points
        count = len(self.points)
        self.hits, self.free, self.other = np.ones(count), np.zeros(count), np.zeros(count)
        self.times = np.full(count, float(stamp))
        self._set_keys(np.zeros(0, np.int64) if keys is None else keys)

    def _set_keys(self, keys: Keys) -> None:
        """Takes the voxels that there are now, of which nothing is worked out yet."""
        self._keys = keys
        self._tree: cKDTree | None = None
        self._bounds: tuple[Array, Array] | None = None
        self._middle: Array | None = None

    @classmethod
    def of(cls, points: Array, side: float, stamp: int = 0) -> VoxelSet:
        """Returns the voxels of one view's points (N, 3)."""
        return cls.of_each([points], side, stamp)[0]

    @classmethod
    def of_each(cls, sets: Sequence[Array], side: float, stamp: int = 0) -> list[VoxelSet]:
        """Returns the voxels of each of several sets of one view's points: together they take a third of the time."""
        if not sets:
            return []
        points = np.concatenate(sets)
        keys, own = keys_of(points, side), np.repeat(np.arange(len(sets)), [len(p) for p in sets])
        order = np.argsort(keys, kind="stable")
        order = order[np.argsort(own[order], kind="stable")]  # by set, then by voxel
        ranked, of_set = keys[order], own[order]
        first = np.ones(len(order), np.bool_)
        first[1:] = (ranked[1:] != ranked[:-1]) | (of_set[1:] != of_set[:-1])
        of = np.empty(len(order), np.intp)
        of[order] = np.cumsum(first) - 1
        counts = np.bincount(of)
        means = np.stack([np.bincount(of, column) for column in points.T], axis=1) / counts[:, None]
        ends = np.cumsum(np.bincount(of_set[first], minlength=len(sets)))[:-1]
        parts = zip(np.split(ranked[first], ends), np.split(means, ends), strict=True)
        return [cls(side, own_keys, own_means, stamp) for own_keys, own_means in parts]

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, other: VoxelSet) -> None:
        """Takes in the voxels of another view, or of another object that is the same."""
        keys, own, new = _merged(self._keys, other._keys)

        def together(mine: Array, others: Array) -> Array:
            if len(keys) == len(mine):
                sums = mine.copy()
            else:
                sums = np.zeros(len(keys))
                sums[own] = mine
            sums[new] += others
            return sums

        hits = together(self.hits, other.hits)
        most = np.maximum(hits, 1e-9)
        points = np.empty((len(keys), 3))
        for mine, others, mean in zip(self.points.T, other.points.T, points.T, strict=True):
            np.divide(together(mine * self.hits, others * other.hits), most, out=mean)
        self.times = together(self.times * self.hits, other.times * other.hits) / most
        self.free = together(self.free, -other.hits).clip(min=0)  # a voxel that is seen again was not free after all
        self.other = together(self.other, other.other)
        self.hits, self.points = hits, points
        self._set_keys(keys)

    def correct(self, correction: Correction) -> None:
        """Moves each voxel with the place from which it was seen; those that fall into one are one."""
        points = correction.moved(self.points, self.times)
        keys, of = np.unique(keys_of(points, self.side), return_inverse=True)
        count, weights = len(keys), np.maximum(self.hits, 1e-9)
        total = np.bincount(of, weights, count)
        means = [np.bincount(of, weights * each, count) / total for each in (*points.T, self.times)]
        counts = (np.bincount(of, each, count) for each in (self.hits, self.free, self.other))
        self.hits, self.free, self.other = (np.asarray(each, np.float64) for each in counts)
        self.points, self.times = np.stack(means[:3], axis=1), means[3]
        self._set_keys(keys)

    def carve(self, free: NDArray[np.bool_]) -> None:
        """Counts the voxels that a view saw through, and drops those that were seen through too often."""
        if not free.any():
            return
        self.free = self.free + free
        gone = (self.free >= 3) & (self.free > 0.5 * self.hits)
        if gone.any():
            for name in _COLUMNS:
                setattr(self, name, getattr(self, name)[~gone])
            self._set_keys(self._keys[~gone])

    def doubt(self, confirmed: NDArray[np.bool_], shown: VoxelSet, weight: int) -> None:
        """Counts the confirmed voxels that are not near those which the object showed in the same view, as `weight`."""
        rows = np.flatnonzero(confirmed)
        if not (len(shown) and len(rows)):
            return
        reach = 1.5 * self.side
        same = np.minimum(np.searchsorted(shown._keys, self._keys[rows]), len(shown) - 1)
        apart = self.points[rows] - shown.points[same]  # most are near what is shown in their own voxel
        rows = rows[np.einsum("ij,ij->i", apart, apart) >= reach * reach]
        if len(rows):
            self.other[rows[~shown.near_each(self.points[rows], reach)]] += weight

    def near_each(self, points: Array, distance: float) -> NDArray[np.bool_]:
        """Returns which points (N, 3) lie within a distance of a voxel's mean."""
        if len(points) * len(self) <= _FEW:  # sooner compared each with each than put into a tree
            square = np.zeros((len(points), len(self)))
            for axis in range(3):
                apart = points[:, axis, None] - self.points[None, :, axis]
                square += apart * apart
            return np.asarray((square < distance * distance).any(axis=1))
        low, high = self.bounds
        found = np.zeros(len(points), np.bool_)
        columns = np.ascontiguousarray(points.T)
        within = (columns > (low - distance)[:, None]) & (columns < (high + distance)[:, None])
        around = np.flatnonzero(within[0] & within[1] & within[2])
        apart, _ = self.tree().query(points[around], distance_upper_bound=distance)
        found[around] = np.isfinite(apart)
        return found

    def sure(self, others: Sequence[VoxelSet] = ()) -> Array:
        """Returns the points (N, 3) of the voxels that are not seen far less often than the others.

        Those that `others` have too are theirs, unless too few would be left.
        """
        if not len(self):
            return self.points
        least = 0.25 * _upper_quartile(self.hits)
        kept = (self.hits >= least) & (self.hits > self.free) & (self.hits >= self.other)
        if not kept.any():
            return self.points
        own = kept.copy()
        for other in others:
            if len(other):
                place = np.minimum(np.searchsorted(other._keys, self._keys), len(other) - 1)
                own &= other._keys[place] != self._keys
        return self.points[own if np.count_nonzero(own) >= _LEAST else kept]

    @property
    def middle(self) -> Array:
        """Mean (3,) of the voxels."""
        if self._middle is None:
            self._middle = np.asarray(self.points.sum(axis=0) / max(len(self.points), 1))
        return self._middle

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest coordinates (3,) of the voxels; infinite and the wrong way round where there are none."""
        if self._bounds is None:
            columns = np.ascontiguousarray(self.points.T)  # along which extremes are found many times as fast
            self._bounds = columns.min(axis=1, initial=np.inf), columns.max(axis=1, initial=-np.inf)
        return self._bounds

    @property
    def extent(self) -> Array:
        """Size (3,) of the bounds."""
        low, high = self.bounds
        return high - low

    def tree(self) -> cKDTree:
        """Returns the voxels' means for questions of what is near."""
        if self._tree is None:
            self._tree = cKDTree(self.points, balanced_tree=False, compact_nodes=False)
        return self._tree

    def near(self, points: Array, distance: float) -> float:
        """Returns the share of points (N, 3), of 100 of many, that lie within a distance of a voxel's mean."""
        if not len(self) or not len(points):
            return 0.0
        apart, _ = self.tree().query(points[:: -(-len(points) // 100)], distance_upper_bound=distance)
        return float(np.isfinite(apart).mean())

    def apart(self, other: VoxelSet) -> float:
        """Returns how far the axis-parallel bounds of two sets are apart along the axis along which they are most.

        Negative where they overlap; infinite where one is empty.
        """
        (a, b), (c, d) = self.bounds, other.bounds
        return float((np.maximum(a, c) - np.minimum(b, d)).max())

    # snapshot and restore are written out: saved maps hold what they give, and those of earlier versions are read

    def snapshot(self) -> dict[str, Any]:
        return {"keys": self._keys} | {name: getattr(self, name) for name in _COLUMNS}

    def restore(self, state: dict[str, Any]) -> None:
        earlier = {"times": np.zeros(len(state["hits"]))}  # earlier versions have none
        for name in _COLUMNS:
            setattr(self, name, np.array({**earlier, **state}[name], np.float64))
        self.points = self.points.reshape(-1, 3)
        self._set_keys(np.array(state["keys"], np.int64))


def standing_box(points: Array) -> tuple[Array, Array, float]:
    """Returns centre (3,), full size (3,) and heading of the upright box of least area around points (N, 3), N ≥ 1."""
    (x, y), (width, depth), angle = cv2.minAreaRect((points[:, :2] - points[0, :2]).astype(np.float32))
    low, high = float(points[:, 2].min()), float(points[:, 2].max())
    center = np.array([x + points[0, 0], y + points[0, 1], (low + high) / 2])
    return center, np.array([width, depth, high - low]), float(np.radians(angle))


def _upper_quartile(values: Array) -> float:
    """Returns the 75th percentile of values (N,), in a tenth of the time that `np.percentile` takes for a few."""
    place = 0.75 * (len(values) - 1)
    before, after = math.floor(place), math.ceil(place)
    ranked = np.partition(values, (before, after))
    low, high = float(ranked[before]), float(ranked[after])
    return low + (place - before) * (high - low)


def _merged(own: Keys, other: Keys) -> tuple[Keys, slice | NDArray[np.intp], NDArray[np.intp]]:
    """Returns the rising keys that either has, and where those of each (rising, each once) are among them."""
    place = np.searchsorted(own, other)
    fresh = np.ones(len(place), np.bool_)
    if len(own):
        fresh = own[np.minimum(place, len(own) - 1)] != other
    count = int(np.count_nonzero(fresh))
    if not count:
        return own, slice(None), place
    new = place + np.cumsum(fresh) - fresh  # by so many are those before it more
    keys = np.empty(len(own) + count, np.int64)
    kept = np.ones(len(keys), np.bool_)
    kept[new[fresh]] = False
    before = np.flatnonzero(kept)
    keys[before], keys[new] = own, other
    return keys, before, new
