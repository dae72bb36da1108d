"""Things that stand in a case side by side, as books in a shelf: spines show, and neighbours hide the rest."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operators.scene.kinds import Kinds
from operators.scene.map_object import MapObject

Array = NDArray[np.float64]
_AROUND = 0.1  # metres by which the box of a case may be too small
_STANDS = 1.5  # times as high as thin is what stands


def fronts(objects: Sequence[MapObject], cases: Sequence[MapObject], kinds: Kinds) -> Array:
    """Returns for each object (N,) the heading along which the case lies deep that it is in, rad; NaN where in none."""
    found = np.full(len(objects), np.nan)
    rows = [k for k, o in enumerate(objects) if kinds.shows_spine(o)]
    if not rows or not cases:
        return found
    middles = np.array([objects[k].cells.middle for k in rows])
    yaws = np.array([o.yaw for o in cases])
    sizes = np.array([o.size for o in cases])
    way = middles[:, None] - np.array([o.center for o in cases])
    c, s = np.cos(yaws), np.sin(yaws)
    local = np.stack([c * way[..., 0] + s * way[..., 1], c * way[..., 1] - s * way[..., 0], way[..., 2]], axis=-1)
    away = np.linalg.norm(np.maximum(np.abs(local) - sizes / 2, 0), axis=2)
    nearest = away.argmin(axis=1)
    deep = np.where(sizes[:, 0] < sizes[:, 1], yaws, yaws + np.pi / 2)
    found[rows] = np.where(away.min(axis=1) <= _AROUND, deep[nearest], np.nan)
    return found


def front_of(object: MapObject, cases: Sequence[MapObject], kinds: Kinds) -> float | None:
    """Returns the same of one object; None where it is in no case."""
    front = float(fronts([object], cases, kinds)[0])
    return None if math.isnan(front) else front


def stands(object: MapObject) -> bool:
    """Tells whether a thing that may lie stands."""
    return float(object.size[2]) > _STANDS * float(object.size[:2].min())
