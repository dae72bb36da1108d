"""Things of a class that stand side by side: what one view shows of them is divided where it looks between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from operators.scene.cuboid import ImageView
from operators.scene.range_view import RangeView

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_GAP, _GROWTH = 0.08, 0.02  # metres, and this share of the range, from which points along the room are apart
_AROUND = 0.5  # metres from a gap, within which points show where its front is
_FRONT = 0.1  # share of those points that may be nearer
_PLACES = (0.25, 0.5, 0.75)  # of a gap that are looked at
_LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)  # and of the heights of the points around it
_OPEN, _LOOKED = 0.6, 5  # share of these places that nothing hides, and how many must be looked at
_FEWEST = 20  # points


def largest_part(points: Array, heading: float, view: RangeView, margin: float) -> Mask | None:
    """Tells which of one view's points (N, 3), z up, are of its largest part; None where there is only one.

    Parts are apart along the room, whose `heading` is given in radians: nothing of the thing shows between them at any
    height, though nothing else hides what is there. A place is hidden by what is farther than `margin`, m, before it.
    """
    kept = np.ones(len(points), np.bool_)
    for turn in (0.0, np.pi / 2):
        rows = np.flatnonzero(kept)
        if len(rows) < _FEWEST:
            break
        c, s = np.cos(heading + turn), np.sin(heading + turn)
        T = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # from the world to axes along the room
        local, eye = points[rows] @ T.T, T @ view.origin
        order = np.argsort(local[:, 0], kind="stable")
        along = local[order, 0]
        least = _GAP + _GROWTH * float(np.linalg.norm(local.mean(axis=0) - eye))
        ends = np.flatnonzero(np.diff(along) > least)
        ends = ends[[_is_open(local, along[k], along[k + 1], eye, T, view, margin) for k in ends.tolist()]]
        if len(ends):
            parts = np.split(order, ends + 1)
            kept[:] = False
            kept[rows[max(parts, key=len)]] = True
    return None if kept.all() else kept


def _is_open(local: Array, low: float, high: float, eye: Array, T: Array, view: RangeView, margin: float) -> bool:
    """Tells whether a view shows that nothing is between two places along the first axis of points (N, 3).

    `T` (3, 3) turns the world to the axes of the points, in which the viewer is at `eye` (3,).
    """
    near = local[(local[:, 0] > low - _AROUND) & (local[:, 0] < high + _AROUND)]
    behind = float(np.quantile(near[:, 1], _FRONT)) > eye[1]
    front = float(np.quantile(near[:, 1], _FRONT if behind else 1 - _FRONT))
    heights = np.quantile(near[:, 2], _LEVELS)
    places = np.array([[low + share * (high - low), front, z] for share in _PLACES for z in heights.tolist()])
    sight = view.of(places @ T, margin)
    looked = int(np.count_nonzero(sight.looked))
    return looked >= _LOOKED and int(np.count_nonzero(sight.free | sight.confirmed)) >= _OPEN * looked


def image_of_part(image: ImageView, points: Array, kept: Mask) -> ImageView:
    """Returns what an image shows of a part (`kept`) of the points (N, 3): its box ends there on the side of the rest.

    That edge is not the thing's own, since masks and clouds lose some of its brink.
    """
    seen = points @ image.P[:, :3].T + image.P[:, 3]
    columns = seen[:, 0] / seen[:, 2]
    own, rest = columns[kept], columns[~kept]
    box, edges = image.box.copy(), image.edges.copy()
    if float(rest.mean()) < float(own.mean()):
        box[0], edges[0] = max(float(own.min()), box[0]), False
    else:
        box[2], edges[2] = min(float(own.max()), box[2]), False
    return replace(image, box=box, edges=edges)
