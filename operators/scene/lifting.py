"""Points of a cloud that belong to boxes in an image: smooth pieces of the view, and which of them are the object."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from operators.cloud.clustering import level_axes, upright_box
from operators.cloud.filtering import Voxels
from operators.scene.body_points import beyond, body_of
from operators.scene.range_segments import range_segments

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_FEWEST = 5  # points of a part
_MIDDLE = 0.5  # what holding all points in the middle of a box counts, beside the overlap
_SAME = 0.5  # overlap from which two boxes are around the same thing
_SAME_BODY = 0.2  # that overlap where most of the points are in both
_SMALLER = 4.0  # times smaller, and a box in another is in front
_LEFT = 0.3  # share of its points that an object keeps
_GAIN = 0.01  # of overlap with its box by a further part of an object
_LOSS = 0.05  # of it by a part that is on the object's mask
_AROUND = 0.1  # of a box's sides, by which boxes are drawn too tight
_OUTSIDE = 0.5  # what lying in the box as a whole counts, beside the overlap: what goes on is behind or below
_CONTAINED = 0.6  # share of a piece in the box from which it may be a further part of the object


@dataclass(frozen=True)
class LiftSettings:
    """Lengths in metres. `reach` and `reach_growth` say how near neighbours are: reach + growth * distance."""

    reach: float = 0.04
    reach_growth: float = 0.012
    gap: float = 0.3
    min_points: int = 8
    min_overlap: float = 0.3
    mask_share: float = 0.15
    body_share: float = 0.08


@dataclass(frozen=True, eq=False)
class Seen:
    """A cloud as the camera sees it: points (N, 3), their pixels (N, 2), which are in the image, and up (3,).

    `classes` (N,) is the class of each point's pixel, -1 where it has none; None without masks. `grain` is the number
    of pixels by which the image of an object's points is smaller than the object's image on each side.
    """

    points: Array
    pixels: Array
    inside: Mask
    up: Array
    classes: NDArray[np.int32] | None = None
    grain: float = 0.0

    @cached_property
    def places(self) -> Array:
        """Pixels and points by coordinate (5, N), so that extents are found along rows."""
        return np.ascontiguousarray(np.concatenate([self.pixels, self.points], axis=1).T)


@dataclass(frozen=True, eq=False)
class Lifted:
    """One box's object: its points (indices), the IoU of its image with the box, and its upright box.

    `T` (4, 4) maps the upright box's axes, z along up, to the cloud's frame; `size` (3,) is its full size.
    """

    detection: int
    points: Indices
    overlap: float
    T: Array
    size: Array


def lift(
    seen: Seen,
    boxes: Array,
    mask_classes: Sequence[int],
    background: Sequence[int],
    s: LiftSettings,
    bodies: Collection[int] = (),
    instances: Sequence[Mask] | None = None,
) -> list[Lifted]:
    """Finds the object of each image box (M, 4) among a cloud's points; boxes without one are left out.

    The view is divided into smooth pieces once. Of those in a box the one whose image overlaps it best and that does
    not go on beyond it is the object, with those near it that make the overlap better. `mask_classes` (M,) is the
    mask's class of each box, -1 for none. Where the box holds enough of it, only such points count, wherever their
    piece goes on; otherwise points of `background` classes do not. Points go to the box that they fit best, once.
    `instances` (M) are masks (H, W) of the objects themselves; where they are known, their points count alone.

    For the boxes in `bodies` the mask counts more than the edges: the object is the connected part of its mask, also
    beyond the box, and its share of the mask in the box replaces the overlap.
    """
    candidates: list[tuple[int, Indices, float]] = []
    inside = np.flatnonzero(seen.inside)
    order = inside[np.argsort(seen.pixels[inside, 0], kind="stable")]
    columns, lines = seen.pixels[order, 0], seen.pixels[order, 1]
    classes = None if seen.classes is None else seen.classes[order]
    behind = None if classes is None else _among(classes, np.array(background, np.int64))
    pieces = range_segments(seen.points, seen.pixels, seen.inside, _reach(seen.points, s))
    whole = _counts(pieces, int(pieces.max(initial=-1)) + 1)
    for k, (left, upper, right, lower) in enumerate(boxes.tolist()):
        wide, high = _AROUND * (right - left) + 2, _AROUND * (lower - upper) + 2
        first, last = np.searchsorted(columns, [left - wide, right + wide], side="left")
        u, v, near = columns[first:last], lines[first:last], order[first:last]
        inner = (u >= left) & (u <= right) & (v >= upper) & (v <= lower)
        if np.count_nonzero(inner) < s.min_points:
            continue
        box, contained = (left, upper, right, lower), None
        rows: Indices | None
        if instances is not None:
            rows = _on(instances[k], seen, near[inner])
        elif (rows := _of_class(near, inner, classes, first, mask_classes[k], k in bodies, s)) is None:
            if k in bodies:
                continue
            rows = near[inner if behind is None else inner & ~behind[first:last]]
            around = near[(v >= upper - high) & (v <= lower + high)]
            contained = _counts(pieces[around], len(whole)) / whole
        elif k in bodies and classes is not None:
            body = _body(seen, columns, lines, classes == mask_classes[k], order, box, s)
            candidates += [] if body is None else [(k, *body)]
            continue
        assert rows is not None
        found = _object(seen, np.sort(rows), pieces, contained, box, s)
        if found is not None:
            candidates.append((k, *found))
    owned, level = _divided(seen.places[:2], boxes, candidates, bodies), level_axes(seen.up)
    kept = [
        Lifted(k, own, value, *upright_box(seen.points[own], seen.up, level))
        for (k, points, value), own in zip(candidates, owned, strict=True)
        if len(own) >= max(_FEWEST, _LEFT * len(points))  # else others have it
    ]
    return sorted(kept, key=lambda c: c.detection)


def _on(mask: Mask, seen: Seen, rows: Indices) -> Indices:
    """Returns those of some points that are on an object's mask (H, W)."""
    columns, lines = seen.places[:2].take(rows, axis=1).astype(np.intp)
    return np.asarray(rows[mask[lines, columns]])


def _of_class(
    near: Indices,
    inner: Mask,
    classes: NDArray[np.int32] | None,
    first: int,
    wanted: int,
    body: bool,
    s: LiftSettings,
) -> Indices | None:
    """Returns the points `near` a box that are in it and of its class in the mask; None where these are too few.

    `classes` are those of all points by rising column, of which `near` begin at `first`.
    """
    if classes is None or wanted < 0:
        return None
    own = inner & (classes[first : first + len(near)] == wanted)
    share = s.body_share if body else s.mask_share
    enough = np.count_nonzero(own) >= max(s.min_points, share * np.count_nonzero(inner))
    return near[own] if enough else None


def _body(
    seen: Seen,
    columns: Array,
    lines: Array,
    own: Mask,
    order: Indices,
    box: tuple[float, float, float, float],
    s: LiftSettings,
) -> tuple[Indices, float] | None:
    """Returns the points of the body that a box is around, and the share of its mask in the box that they are.

    `columns`, `lines` and `own`, whether it is of the mask, are of the points `order`, by rising column.
    """
    left, upper, right, lower = beyond(box)
    first, last = np.searchsorted(columns, [left, right])
    u, v = columns[first:last], lines[first:last]
    taken = own[first:last] & (v >= upper) & (v <= lower)
    u, v, rows = u[taken], v[taken], order[first:last][taken]
    points = seen.points[rows]
    reach = s.reach + s.reach_growth * float(np.sqrt(np.median((points * points).sum(axis=1))))
    voxels = Voxels.by_size(points.astype(np.float32), reach / 2)
    inner = (u >= box[0]) & (u <= box[2]) & (v >= box[1]) & (v <= box[3])
    found = body_of(points, inner, _linked(voxels.means(points), reach)[voxels.of], seen.up)
    if found is None or len(found[0]) < s.min_points or found[1] < s.min_overlap:
        return None
    return np.sort(rows[found[0]]), found[1]


def _divided(
    pixels: Array, boxes: Array, candidates: Sequence[tuple[int, Indices, float]], bodies: Collection[int]
) -> list[Indices]:
    """Returns what each candidate (box, points, overlap) keeps of its points, at `pixels` (2, N): each goes to one.

    Of boxes around the same thing the better one gets all. Of others a much smaller one does, since it is in front;
    else each point goes to the box whose middle is nearer, as measured by the boxes' sides.
    """
    owner = np.full(pixels.shape[1], -1)
    distance = np.zeros(pixels.shape[1])
    middles, sides = (boxes[:, :2] + boxes[:, 2:]) / 2, np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    order = sorted(range(len(candidates)), key=lambda c: (-candidates[c][2], candidates[c][0]))
    for c in order:
        k, points, _ = candidates[c]
        away = np.maximum(*np.abs((pixels.take(points, axis=1) - middles[k, :, None]) / sides[k, :, None]))
        before = owner[points]
        wins = before < 0
        for rival in np.unique(before[~wins]).tolist():
            other = candidates[rival][0]
            alike = _overlap(tuple(boxes[k].tolist()), tuple(boxes[other].tolist()))
            same = alike >= _SAME
            ratio = float(np.prod(sides[k]) / np.prod(sides[other]))
            nearer = away < distance[points] if 1 / _SMALLER < ratio < _SMALLER else ratio <= 1 / _SMALLER
            shared = int(np.count_nonzero(before == rival)) if {k, other} <= set(bodies) else 0
            same = same or (alike >= _SAME_BODY and shared >= len(points) // 2)
            wins |= (before == rival) & np.asarray(nearer & (not same))
        owner[points[wins]], distance[points[wins]] = c, away[wins]
    return [points[owner[points] == c] for c, (_, points, _) in enumerate(candidates)]


def _reach(points: Array, s: LiftSettings) -> Array:
    """Returns how near (N,) neighbours of one surface are to points (N, 3)."""
    return np.asarray(s.reach + s.reach_growth * np.sqrt(np.einsum("ij,ij->i", points, points)))


def _counts(pieces: NDArray[np.int32], number: int) -> NDArray[np.intp]:
    """Returns how many points each piece has, -1 being none."""
    return np.asarray(np.bincount(pieces[pieces >= 0], minlength=number), np.intp)


def _object(
    seen: Seen,
    rows: Indices,
    pieces: NDArray[np.int32],
    contained: Array | None,
    box: tuple[float, float, float, float],
    s: LiftSettings,
) -> tuple[Indices, float] | None:
    """Returns the points of the object in a box and the overlap of their image with it.

    `rows` are those that may be of it, `contained` the share of each piece that is in the box; None where a mask shows
    it.
    """
    rows = rows[pieces[rows] >= 0]
    if not len(rows):
        return None
    rows = rows[np.argsort(pieces[rows], kind="stable")]
    begin = np.flatnonzero(np.diff(pieces[rows], prepend=-1))
    number, sizes = pieces[rows[begin]], np.diff(begin, append=len(rows))
    places = seen.places.take(rows, axis=1)
    low, high = np.minimum.reduceat(places, begin, axis=1), np.maximum.reduceat(places, begin, axis=1)
    low[:2] -= seen.grain
    high[:2] += seen.grain
    whole = np.ones(len(number)) if contained is None else contained[number]
    values = _overlaps(low[:2], high[:2], box)
    central = np.add.reduceat(_central(places[:2], box), begin)
    middle = _MIDDLE * central / max(int(central.sum()), _FEWEST)
    ranks = np.where(sizes >= _FEWEST, values + middle + _OUTSIDE * whole, -1.0)
    order = np.argsort(-ranks, kind="stable")
    order = order[ranks[order] >= 0]
    if not len(order):
        return None
    best: tuple[float, list[int], float] = (-1.0, [], 0.0)
    kept = order[whole[order] >= _CONTAINED]
    for first in dict.fromkeys([int(order[0]), *kept[:1].tolist()]):
        parts = [first, *(c for c in order.tolist() if c != first and whole[c] >= min(_CONTAINED, whole[first]))]
        gain = _GAIN if contained is not None else -_LOSS
        chosen, value = _joined(low, high, parts, float(values[first]), box, s.gap, gain)
        rank = value + float(middle[chosen].sum() + _OUTSIDE * np.average(whole[chosen], weights=sizes[chosen]))
        best = max(best, (rank, chosen, value), key=lambda each: each[0])
    _, chosen, value = best
    if value < s.min_overlap or sizes[chosen].sum() < s.min_points:
        return None
    return np.sort(np.concatenate([rows[begin[c] : begin[c] + sizes[c]] for c in chosen])), value


def _joined(
    low: Array,
    high: Array,
    parts: Sequence[int],
    value: float,
    box: tuple[float, float, float, float],
    gap: float,
    gain: float,
) -> tuple[list[int], float]:
    """Returns the first of some parts with those near it by which the overlap with the box gains, and that overlap.

    The parts reach from `low` to `high` (5, N), in pixels and in space; `value` is the overlap of the first one.
    """
    chosen, least, most = [parts[0]], low[:, parts[0]], high[:, parts[0]]
    for c in parts[1:]:
        apart = np.maximum(np.maximum(least, low[:, c]) - np.minimum(most, high[:, c]), 0)[2:]
        if float(apart @ apart) > gap * gap:
            continue
        both = np.minimum(least, low[:, c]), np.maximum(most, high[:, c])
        better = _overlap((*both[0][:2], *both[1][:2]), box)
        if better > value + gain:
            chosen, value, least, most = [*chosen, c], better, *both
    return chosen, value


def _among(values: NDArray[np.integer[Any]], chosen: NDArray[np.int64]) -> Mask:
    """Tells which of some numbers (N,) of a small range are among others: in a third of the time of `np.isin`."""
    if not len(values) or not len(chosen):
        return np.zeros(len(values), np.bool_)
    low = min(int(values.min()), int(chosen.min()))
    table = np.zeros(max(int(values.max()), int(chosen.max())) - low + 1, np.bool_)
    table[chosen - low] = True
    return np.asarray(table[values - low])


def _central(pixels: Array, box: tuple[float, float, float, float]) -> NDArray[np.intp]:
    """Returns 1 for pixels (2, N) in the inner half of a box, else 0: what shows around a thing has few there."""
    wide = np.abs(pixels[0] - (box[0] + box[2]) / 2) <= (box[2] - box[0]) / 4
    high = np.abs(pixels[1] - (box[1] + box[3]) / 2) <= (box[3] - box[1]) / 4
    return np.asarray(wide & high, np.intp)


def _linked(places: Array, reach: float) -> NDArray[np.intp]:
    """Returns the group of each place (N, 3): those within reach of each other, directly or by others, are one."""
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (len(places), len(places)))
    return np.asarray(connected_components(graph, directed=False)[1], np.intp)


def _overlaps(low: Array, high: Array, box: tuple[float, float, float, float]) -> Array:
    """Returns the IoU (N,) of image boxes, from `low` to `high` (2, N), with one."""
    corner, end = np.array(box[:2])[:, None], np.array(box[2:])[:, None]
    shared = np.maximum(np.minimum(high, end) - np.maximum(low, corner), 0).prod(axis=0)
    return np.asarray(shared / ((high - low).prod(axis=0) + (end - corner).prod() - shared))


def _overlap(first: tuple[float, float, float, float], second: tuple[float, float, float, float]) -> float:
    """Returns the IoU of two image boxes."""
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (first, second)]
    return width * height / (areas[0] + areas[1] - width * height)
