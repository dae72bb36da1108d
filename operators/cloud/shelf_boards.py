"""Things on the boards of furniture, told apart from it: a bookcase and its books touch, so no distance does that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.cloud.clustering import dbscan
from operators.cloud.normals import estimate_normals

Array = NDArray[np.float64]
Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]

_LARGE = 0.6  # metres across a cluster that may be furniture
_SHARE = 0.5  # of such a cluster that must lie in its surfaces
_UPRIGHT = 0.35  # metres that an upright surface is long at least
_WIDE = 0.1  # metres that any surface is wide at least
_FEWEST = 15  # points of a surface
_MOST = 12  # surfaces across one axis
_ACROSS = 0.85  # cosine between an axis and the normals of the points by which a surface across it is found
_LEANING = 0.6  # and of those that it takes
_CLEAR = 0.6  # share of the points at a surface's place that face across it: no slice through something solid
_NOISE, _NOISE_GROWTH = 0.012, 0.002  # metres, and 1/m times the squared distance, by which points are off a surface


@dataclass(frozen=True, eq=False)
class Points:
    """Means of voxels (N, 3) in metres with their counts (N,) and their reach (N,), in the frame of the sensor."""

    means: Array
    counts: NDArray[np.intp]
    reach: Array

    def chosen(self, which: NDArray[np.intp] | Mask) -> Points:
        return Points(self.means[which], self.counts[which], self.reach[which])


def with_contents(labels: Labels, points: Points, up: Array, core: int, fewest: int, board: float) -> Labels:
    """Returns the labels (N,) of clusters, with new ones for the things in furniture.

    A large cluster is furniture where most of it lies in two or more surfaces that are level or upright and at right
    angles to each other, one of them a board of `board` metres or more. The remaining points are clustered anew,
    with the same reach and `core` as in `dbscan`; parts with `fewest` counts are things, all else stays furniture.
    """
    found = labels.copy()
    sizes = np.bincount(labels[labels >= 0], points.counts[labels >= 0])
    for k in np.flatnonzero(sizes >= 5 * fewest):
        members = np.flatnonzero(labels == k)
        own = points.chosen(members)
        if np.linalg.norm(np.ptp(own.means, axis=0)) < _LARGE:
            continue
        left = ~furniture(own, up, board)
        rest = own.chosen(left)
        part = dbscan(rest.means, rest.reach, core, rest.counts)
        masses = np.bincount(part[part >= 0], rest.counts[part >= 0])
        for thing in np.flatnonzero(masses >= fewest) if not left.all() else ():
            found[members[left][part == thing]] = found.max() + 1
    return found


def furniture(points: Points, up: Array, board: float) -> Mask:
    """Returns which points (N,) of a cluster lie in the boards, sides and back of furniture; none where it is none."""
    radius = 2 * float(points.reach.mean())
    normals = estimate_normals(points.means, neighbours=12, radius=radius, viewpoint=np.zeros(3))
    axes = _axes(normals[np.isfinite(normals).all(axis=1)], up)
    level, boards = _across(points, normals, axes, board, level=True)
    sides = [_across(points, normals, np.roll(axes, -k, axis=0), _UPRIGHT, level=False) for k in (1, 2)]
    inside = level | sides[0][0] | sides[1][0]
    count = boards + sides[0][1] + sides[1][1]
    is_furniture = boards > 0 and count > 1 and inside.mean() >= _SHARE
    return inside if is_furniture else np.zeros_like(inside)


def _axes(normals: Array, up: Array) -> Array:
    """Returns up and two level directions (3, 3) at right angles that most upright surfaces face along."""
    flat = normals[np.abs(normals @ up) < 0.3]
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(up)))], up)
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    turn = float(np.angle(np.exp(4j * np.arctan2(flat @ y, flat @ x)).sum())) / 4  # a quarter turn changes nothing
    along = np.cos(turn) * x + np.sin(turn) * y
    return np.stack([up, along, np.cross(up, along)])


def _across(points: Points, normals: Array, axes: Array, length: float, *, level: bool) -> tuple[Mask, int]:
    """Returns which points lie in surfaces across the first of the axes (3, 3), and the number of these surfaces.

    A surface has a connected part of that `length`. Of a board everything at its height is taken, since things that
    stand on it hide it in part; of an upright surface only what is around such parts, as books in several rows can have
    one plane in common.
    """
    height, spread = points.means @ axes[0], points.means @ axes[1:].T
    noise = _NOISE + _NOISE_GROWTH * np.square(points.means).sum(axis=1)
    cosine = np.abs(normals @ axes[0])
    lying = ~(cosine <= _LEANING)  # true for points without a normal, too
    free = cosine > _ACROSS
    inside, count = np.zeros(len(height), np.bool_), 0
    for _ in range(_MOST):
        at = _densest(height[free], 2 * float(np.median(noise[free]))) if free.sum() >= _FEWEST else None
        if at is None:
            break
        off = np.abs(height - at)
        own = np.flatnonzero(free & (off <= noise))
        free &= off > 2 * noise
        parts = _parts(points.chosen(own), spread[own], length)
        for low, high in parts:
            around = ((spread >= low - 0.03) & (spread <= high + 0.03)).all(axis=1)
            if lying[around & (off <= noise)].mean() >= _CLEAR:
                inside |= (off <= 2 * noise) & lying & (around | level)
                count += 1
    return inside, count


def _densest(values: Array, width: float) -> float | None:
    """Returns the median of the most values that lie within a width of each other; None where they are too few."""
    ordered = np.sort(values)
    counts = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    first = int(counts.argmax())
    if counts[first] < _FEWEST:
        return None
    return float(np.median(ordered[first : first + counts[first]]))


def _parts(points: Points, spread: Array, length: float) -> list[tuple[Array, Array]]:
    """Returns the lower and upper corner (2,) of each connected part of a surface that is long and wide enough."""
    if len(spread) < _FEWEST:
        return []
    part = dbscan(points.means, points.reach, 1, points.counts)
    found = []
    for k in range(int(part.max()) + 1):
        own = spread[part == k]
        if len(own) >= _FEWEST - 5:
            size = np.subtract(*np.quantile(own, (0.97, 0.03), axis=0))
            if size.max() >= length and size.min() >= _WIDE:
                found.append((own.min(axis=0), own.max(axis=0)))
    return found
