"""Points of a cloud that belong to boxes in an image: frustums, clusters, and which cluster is the object."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from operators.cloud.clustering import connected, level_axes, upright_box
from operators.cloud.filtering import Voxels
from operators.scene.lifting.body_points import beyond, body_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_FEWEST = 5  # points of a part
_WHOLE = 0.6  # overlap from which points without a gap in range are not divided
_AS_WELL = 0.8  # share of the best overlap, from which a part fills a box as well
_MIDDLE = 0.5  # what holding all points in the middle of a box counts, beside the overlap
_SAME = 0.5  # overlap from which two boxes are around the same thing
_SAME_BODY = 0.2  # that overlap where most of the points are in both
_SMALLER = 4.0  # times smaller, and a box in another is in front
_LEFT = 0.3  # share of its points that an object keeps
_DENSE = 256  # so many places are compared each with each


@dataclass(frozen=True)
class LiftSettings:
    """Lengths in metres. `reach` and `reach_growth` say how near neighbours are: reach + growth * distance."""

    reach: float = 0.04
    reach_growth: float = 0.012
    gap: float = 0.3
    min_points: int = 8
    min_overlap: float = 0.3
    slab: float = 0.03
    mask_share: float = 0.15
    body_share: float = 0.08


@dataclass(frozen=True, eq=False)
class ProjectedCloud:
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
        places = np.empty((5, len(self.points)))
        places[:2], places[2:] = self.pixels.T, self.points.T
        return places

    def ranges(self, rows: Indices) -> Array:
        """Returns the distances (K,) of some points from the origin of their frame."""
        x, y, z = self.places[2:].take(rows, axis=1)
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    @cached_property
    def columns(self) -> _Columns:
        return _Columns.of(self)


@dataclass(frozen=True, eq=False)
class _Columns:
    """The points in the image (indices `order`) by column of pixels, of which `starts` has where each begins."""

    order: Indices
    starts: Sequence[int]

    @classmethod
    def of(cls, seen: ProjectedCloud) -> _Columns:
        inside = np.flatnonzero(seen.inside)
        columns = seen.places[0, inside].astype(np.uint16)  # so few bits are sorted in a tenth of the time of floats
        starts = np.cumsum(np.bincount(columns)).tolist()
        return cls(inside[np.argsort(columns, kind="stable")], [0, *starts])

    def between(self, left: float, right: float) -> tuple[int, int]:
        """Returns where the columns that touch an interval begin and end."""
        last = len(self.starts) - 1
        first, end = (min(max(math.floor(u) + more, 0), last) for u, more in ((left, 0), (right, 1)))
        return self.starts[first], self.starts[end]


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


@dataclass(frozen=True, eq=False)
class _Part:
    """One cluster in a box: its points (indices), its bounds in the image (4,) and in space (2, 3)."""

    rows: Indices
    image: tuple[float, float, float, float]
    bounds: Array

    def joined(self, other: _Part) -> _Part:
        low, high = np.minimum(self.bounds[0], other.bounds[0]), np.maximum(self.bounds[1], other.bounds[1])
        return _Part(np.concatenate([self.rows, other.rows]), self.image_with(other), np.stack([low, high]))

    def image_with(self, other: _Part) -> tuple[float, float, float, float]:
        (a, b, c, d), (e, f, g, h) = self.image, other.image
        return (min(a, e), min(b, f), max(c, g), max(d, h))


@dataclass(frozen=True, eq=False)
class _Grown:
    """A part grown by others, the overlap of its image with the box, and how likely it is the object."""

    part: _Part
    value: float
    rank: float


def lift(
    seen: ProjectedCloud,
    boxes: Array,
    mask_classes: Sequence[int],
    background: Sequence[int],
    s: LiftSettings,
    bodies: Collection[int] = (),
    instances: Sequence[Mask] | None = None,
) -> list[Lifted]:
    """Finds the object of each image box (M, 4) among a cloud's points; boxes without one are left out.

    Points in a box are divided into clusters; the one whose image overlaps the box best is the object, with those near
    it that make the overlap better; without masks the nearest of those that overlap it about as well. `mask_classes`
    (M,) is the mask's class of each box, -1 for none. Where the box holds enough of it, only such points count.
    Otherwise points of `background` classes and on level surfaces that reach beyond the box do not. Points go to the
    box that they fit best, once.

    `instances` (M) are masks (H, W) of the objects themselves; where they are known, only points on them count.

    For the boxes in `bodies` the mask counts more than the edges: the object is the connected part of its mask, also
    beyond the box, and its share of the mask in the box replaces the overlap.
    """
    candidates: list[tuple[int, Indices, float]] = []
    order = seen.columns.order
    columns, lines = seen.places[:2].take(order, axis=1)
    classes = None if seen.classes is None else seen.classes[order]
    behind = None if classes is None else _among(classes, np.array(background, np.int64))
    for k, (left, upper, right, lower) in enumerate(boxes.tolist()):
        ring = 0.15 * (right - left) + 2, 0.15 * (lower - upper) + 2
        first, last = seen.columns.between(left - ring[0], right + ring[0])
        u, v, near = columns[first:last], lines[first:last], order[first:last]
        inner = (u >= left) & (u <= right) & (v >= upper) & (v <= lower)
        if np.count_nonzero(inner) < s.min_points:
            continue
        box = (left, upper, right, lower)
        rows: Indices | None
        if instances is not None:
            rows = _on(instances[k], seen, near[inner])
        elif (rows := _of_class(near, inner, classes, first, mask_classes[k], k in bodies, s)) is None:
            if k in bodies:
                continue
            within = (u >= left - ring[0]) & (u < right + ring[0]) & (v >= upper - ring[1]) & (v <= lower + ring[1])
            around = near[within & ~inner]
            rows = _off_support(seen, near[inner if behind is None else inner & ~behind[first:last]], around, s)
        elif k in bodies and classes is not None:
            body = _body(seen, columns, lines, classes == mask_classes[k], box, s)
            candidates += [] if body is None else [(k, *body)]
            continue
        found = _object(seen, np.sort(rows), box, s, masked=instances is not None or classes is not None)
        if found is not None:
            candidates.append((k, *found))
    owned = _divided(seen.places[:2], boxes, candidates, bodies)
    level = level_axes(seen.up)
    kept = [
        Lifted(k, own, value, *upright_box(seen.points[own], seen.up, level))
        for (k, points, value), own in zip(candidates, owned, strict=True)
        if len(own) >= max(_FEWEST, _LEFT * len(points))  # else others have it
    ]
    return sorted(kept, key=lambda c: c.detection)


def _on(mask: Mask, seen: ProjectedCloud, rows: Indices) -> Indices:
    """Returns those of some points that are on an object's mask (H, W)."""
    columns, lines = seen.places[:2].take(rows, axis=1).astype(np.intp)
    return np.asarray(rows[mask[lines, columns]])


def _of_class(
    near: Indices, inner: Mask, classes: NDArray[np.int32] | None, first: int, wanted: int, body: bool, s: LiftSettings
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
    seen: ProjectedCloud,
    columns: Array,
    lines: Array,
    own: Mask,
    box: tuple[float, float, float, float],
    s: LiftSettings,
) -> tuple[Indices, float] | None:
    """Returns the points of the body that a box is around, and the share of its mask in the box that they are.

    `columns`, `lines` and `own`, whether it is of the mask, are of the points in the order of `seen.columns`.
    """
    left, upper, right, lower = beyond(box)
    first, last = seen.columns.between(left, right)
    u, v = columns[first:last], lines[first:last]
    taken = np.flatnonzero(own[first:last] & (u >= left) & (u < right) & (v >= upper) & (v <= lower))
    taken = taken[np.argsort(u[taken], kind="stable")]
    u, v, rows = u[taken], v[taken], seen.columns.order[first:last][taken]
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
    areas, rows = [w * h for w, h in sides.tolist()], [(a, b, c, d) for a, b, c, d in boxes.tolist()]
    order = sorted(range(len(candidates)), key=lambda c: (-candidates[c][2], candidates[c][0]))
    for c in order:
        k, points, _ = candidates[c]
        away = np.maximum(*np.abs((pixels.take(points, axis=1) - middles[k, :, None]) / sides[k, :, None]))
        before = owner[points]
        wins = before < 0
        for rival in np.flatnonzero(np.bincount(before[~wins])).tolist():
            other = candidates[rival][0]
            alike = _overlap(rows[k], rows[other])
            same = alike >= _SAME
            ratio = areas[k] / areas[other]
            nearer = away < distance[points] if 1 / _SMALLER < ratio < _SMALLER else ratio <= 1 / _SMALLER
            shared = int(np.count_nonzero(before == rival)) if {k, other} <= set(bodies) else 0
            same = same or (alike >= _SAME_BODY and shared >= len(points) // 2)
            wins |= (before == rival) & np.asarray(nearer & (not same))
        owner[points[wins]], distance[points[wins]] = c, away[wins]
    return [points[owner[points] == c] for c, (_, points, _) in enumerate(candidates)]


def _off_support(seen: ProjectedCloud, rows: Indices, ring: Indices, s: LiftSettings) -> Indices:
    """Returns the points that are not on a level surface which goes on in the ring around the box."""
    if not len(rows) or len(ring) < s.min_points:
        return rows
    heights, around = seen.points[rows] @ seen.up, seen.points[ring] @ seen.up
    near = np.abs(seen.ranges(ring) - _median(seen.ranges(rows))) < 1
    if np.count_nonzero(near) < _FEWEST:
        return rows
    slabs = np.floor(around[near] / s.slab).astype(np.int64)
    level = np.flatnonzero(np.bincount(slabs - slabs.min()) >= max(_FEWEST, 0.15 * len(ring))) + slabs.min()
    mine = np.floor(heights / s.slab).astype(np.int64)
    kept = rows[~_among(mine, np.concatenate([level, level + 1]))] if len(level) else rows
    return kept if len(kept) >= s.min_points else rows


def _object(
    seen: ProjectedCloud, rows: Indices, box: tuple[float, float, float, float], s: LiftSettings, *, masked: bool
) -> tuple[Indices, float] | None:
    """Returns the points of the object in a box and the overlap of their image with it."""
    if len(rows) < s.min_points:
        return None
    u, v, x, y, z = seen.places.take(rows, axis=1)
    ranges = np.sort(np.sqrt(x * x + z * z + y * y))
    reach = s.reach + s.reach_growth * float(ranges[len(ranges) // 2])
    value = _overlap(_image(seen, u, v), box)
    if value >= _WHOLE and float((ranges[1:] - ranges[:-1]).max()) <= reach:
        return rows, value  # nothing to divide
    points = seen.points[rows]
    voxels = Voxels.by_size(points.astype(np.float32), reach / 2)
    labels = _linked(voxels.means(points), reach)[voxels.of]
    parts = [_part(seen, rows[labels == c]) for c in np.flatnonzero(np.bincount(labels) >= _FEWEST)]
    if not parts:
        return None
    chosen, value = _best(seen, parts, box, s, masked=masked)
    if value < s.min_overlap or len(chosen.rows) < s.min_points:
        return None
    return np.sort(chosen.rows), value


def _best(
    seen: ProjectedCloud,
    parts: Sequence[_Part],
    box: tuple[float, float, float, float],
    s: LiftSettings,
    *,
    masked: bool,
) -> tuple[_Part, float]:
    """Returns the part, grown by others near it, that is the object of a box, and the overlap of its image with it.

    It fills the box best and holds most points in its middle. What shows through a thing (a chair's back of slats)
    fills the box as the thing does: where no masks leave it out, the nearest of what fills it about as well counts.
    """
    grown = _grown(seen, parts, box, s)
    if masked:
        first = next(grown)
        return first.part, first.value
    every = list(grown)
    filling = [each for each in every if each.value >= _AS_WELL * max(other.value for other in every)]
    ranges = [_median(seen.ranges(each.part.rows)) for each in filling]
    near = [each for each, away in zip(filling, ranges, strict=True) if away <= min(ranges) + s.gap]
    best = max(near, key=lambda each: each.rank)
    return best.part, best.value


def _grown(
    seen: ProjectedCloud, parts: Sequence[_Part], box: tuple[float, float, float, float], s: LiftSettings
) -> Iterator[_Grown]:
    """Gives each part together with those near it that make it fill the box better, which are not begun with then.

    It begins with the part that fills the box best and holds most points in its middle.
    """
    values = [_overlap(part.image, box) for part in parts]
    central = [_central(seen, part.rows, box) for part in parts]
    most = max(sum(central), _FEWEST)
    order = sorted(range(len(parts)), key=lambda c: (-values[c] - _MIDDLE * central[c] / most, c))
    left = order
    while left:
        first, *left = left
        chosen, value, middle = parts[first], values[first], central[first]
        for c in order:
            better = _overlap(chosen.image_with(parts[c]), box)
            if c != first and better > value + 0.01 and _apart(chosen.bounds, parts[c].bounds) <= s.gap:
                chosen, value, middle = chosen.joined(parts[c]), better, middle + central[c]
                left = [each for each in left if each != c]
        yield _Grown(chosen, value, value + _MIDDLE * middle / most)


def _among(values: NDArray[np.integer[Any]], chosen: NDArray[np.int64]) -> Mask:
    """Returns which of some numbers (N,) of a small range are among others: in a third of the time of `np.isin`."""
    if not len(values) or not len(chosen):
        return np.zeros(len(values), np.bool_)
    low = min(int(values.min()), int(chosen.min()))
    table = np.zeros(max(int(values.max()), int(chosen.max())) - low + 1, np.bool_)
    table[chosen - low] = True
    return np.asarray(table[values - low])


def _median(values: Array) -> float:
    """Returns the median of values (N,), N ≥ 1, none of them NaN: in a third of the time of `np.median` for a few."""
    ranked, middle = np.sort(values), len(values) // 2
    return float(ranked[middle] if len(values) % 2 else (ranked[middle - 1] + ranked[middle]) / 2)


def _central(seen: ProjectedCloud, rows: Indices, box: tuple[float, float, float, float]) -> int:
    """Counts the points in the inner half of a box: of a thing; what shows around it has few."""
    u, v = seen.places[:2].take(rows, axis=1)
    wide = np.abs(u - (box[0] + box[2]) / 2) <= (box[2] - box[0]) / 4
    return int(np.count_nonzero(wide & (np.abs(v - (box[1] + box[3]) / 2) <= (box[3] - box[1]) / 4)))


def _linked(places: Array, reach: float) -> NDArray[np.intp]:
    """Returns the group of each place (N, 3): those within reach of each other, directly or by others, are one."""
    count = len(places)
    if count > _DENSE:
        return connected(cKDTree(places).query_pairs(reach, output_type="ndarray"), count).astype(np.intp)
    square = np.einsum("ij,ij->i", places, places)
    linked = square[:, None] + square[None, :] - 2 * (places @ places.T) <= reach * reach
    linked.ravel()[:: count + 1] = True
    packed = np.packbits(linked, axis=1, bitorder="little")
    rows, width = packed.tobytes(), packed.shape[1]
    return _groups([int.from_bytes(rows[k : k + width], "little") for k in range(0, len(rows), width)])


def _groups(linked: Sequence[int]) -> NDArray[np.intp]:
    """Returns the group of each place (N,), its first place's number; bit j of `linked[i]` is set if i reaches j."""
    group = np.empty(len(linked), np.intp)
    left = (1 << len(linked)) - 1
    while left:
        first = (left & -left).bit_length() - 1
        reached = waiting = 1 << first
        members = []
        while waiting:
            place = waiting.bit_length() - 1
            members.append(place)
            new = linked[place] & ~reached
            reached |= new
            waiting = (waiting ^ (1 << place)) | new
        group[members] = first
        left &= ~reached
    return group


def _part(seen: ProjectedCloud, rows: Indices) -> _Part:
    own = seen.places.take(rows, axis=1)
    bounds = np.stack([own[2:].min(axis=1), own[2:].max(axis=1)])
    return _Part(rows, _image(seen, own[0], own[1]), bounds)


def _image(seen: ProjectedCloud, u: Array, v: Array) -> tuple[float, float, float, float]:
    """Returns the box around pixels, columns `u` (N,) and lines `v`, of which one in a hundred may stray."""
    cut, g = len(u) // 100, seen.grain
    if not cut:
        return float(u.min()) - g, float(v.min()) - g, float(u.max()) + g, float(v.max()) + g
    last = len(u) - 1 - cut
    u, v = np.partition(u, (cut, last)), np.partition(v, (cut, last))
    return float(u[cut]) - g, float(v[cut]) - g, float(u[last]) + g, float(v[last]) + g


def _overlap(first: tuple[float, float, float, float], second: tuple[float, float, float, float]) -> float:
    """Returns the IoU of two image boxes."""
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (first, second)]
    return width * height / (areas[0] + areas[1] - width * height)


def _apart(first: Array, second: Array) -> float:
    """Returns the gap between the axis-parallel bounds (2, 3) of two groups of points."""
    gap = np.maximum(first[0] - second[1], second[0] - first[1])
    return float(np.linalg.norm(np.maximum(gap, 0)))
