"""Points of a body in a box whose edges are not trusted: those of its mask that hang together in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_BEYOND = 0.3  # of a box's sides, and so much beyond them a body may go on
_FEWEST = 5  # points of a part
_RADIUS = 0.9  # metres on the ground from the middle of what is in the box, within which a body ends
_APART = 0.4  # metres between parts of one body, where what stands before it hides the rest
_LOOSE = 0.15  # metres up to parts that lie outside the box for the most part
_WITHIN = 0.5  # share of a part in the box from which it is not outside


@dataclass(frozen=True, eq=False)
class Part:
    """Some of the points: their rows, how many of them are in the box, and their bounds in space (2, 3)."""

    rows: Indices
    inner: int
    bounds: Array


def beyond(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Returns a box in the image that is so much larger that it holds the body whose box the first one is."""
    left, upper, right, lower = box
    wide, high = _BEYOND * (right - left) + 4, _BEYOND * (lower - upper) + 4
    return left - wide, upper - high, right + wide, lower + high


def body_of(points: Array, inner: NDArray[np.bool_], groups: Indices, up: Array) -> tuple[Indices, float] | None:
    """Returns the rows of a body among the points (N, 3) of its mask, and its share of those in its box (`inner`).

    `groups` (N,) are the clusters of the points. The one with the most points in the box is of the body, and so are
    those near it: an arm or the legs of one who sits behind a table. None where hardly anything is in the box.
    """
    parts = [_part(points, inner, np.flatnonzero(groups == g)) for g in np.flatnonzero(np.bincount(groups) >= _FEWEST)]
    seed = max(parts, key=lambda p: p.inner, default=None)
    if seed is None or seed.inner < _FEWEST:
        return None
    level = points - np.outer(points @ up, up)
    middle = np.median(level[seed.rows[inner[seed.rows]]], axis=0)
    away = np.linalg.norm(level - middle, axis=1)
    low, high = seed.bounds
    chosen = [seed.rows]
    rest = sorted((p for p in parts if p is not seed), key=lambda p: (-p.inner, int(p.rows[0])))
    for part in rest:
        gap = float(np.linalg.norm(np.maximum(np.maximum(low - part.bounds[1], part.bounds[0] - high), 0)))
        if gap <= (_APART if part.inner >= _WITHIN * len(part.rows) else _LOOSE):
            chosen.append(part.rows)
            low, high = np.minimum(low, part.bounds[0]), np.maximum(high, part.bounds[1])
    rows = np.concatenate(chosen)
    rows = np.sort(rows[away[rows] <= _RADIUS])
    return rows, float(np.count_nonzero(inner[rows])) / float(np.count_nonzero(inner))


def _part(points: Array, inner: NDArray[np.bool_], rows: Indices) -> Part:
    own = points[rows]
    return Part(rows, int(np.count_nonzero(inner[rows])), np.stack([own.min(axis=0), own.max(axis=0)]))
