"""Points of a cloud that belong to boxes in an image: frustums, clusters, and which cluster is the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.cloud.clustering import Shape, dbscan, shape_of
from operators.cloud.filtering import Voxels
from operators.tracking.assignment import overlap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_FEWEST = 5  # points of a part
_CORE = 2


@dataclass(frozen=True)
class LiftSettings:
    """Lengths in metres. `reach` and `reach_growth` say how near neighbours are: reach + growth * distance."""

    voxel: float = 0.03
    reach: float = 0.06
    reach_growth: float = 0.02
    gap: float = 0.3
    min_points: int = 8
    min_overlap: float = 0.3
    slab: float = 0.03
    mask_share: float = 0.15


@dataclass(frozen=True, eq=False)
class Seen:
    """A cloud as the camera sees it: points (N, 3), their pixels (N, 2), which are in the image, and up (3,).

    `classes` (N,) is the class of each point's pixel, -1 where it has none; None without masks.
    """

    points: Array
    pixels: Array
    inside: Mask
    up: Array
    classes: NDArray[np.int32] | None = None


@dataclass(frozen=True, eq=False)
class Lifted:
    """One box's object: its points (indices), its shape, and the IoU of its image with the box."""

    detection: int
    points: Indices
    shape: Shape
    overlap: float


def lift(
    seen: Seen, boxes: Array, mask_classes: Sequence[int], background: Sequence[int], s: LiftSettings
) -> list[Lifted]:
    """Finds the object of each image box (M, 4) among a cloud's points; boxes without one are left out.

    Points in a box are divided into clusters; the one whose image overlaps the box best is the object, with those near
    it that make the overlap better. `mask_classes` (M,) is the mask's class of each box, -1 for none. Where the box
    holds enough of it, only such points count. Otherwise points of `background` classes and on level surfaces that
    reach beyond the box do not. Points go to the box that they fit best, once.
    """
    candidates: list[Lifted] = []
    inside = np.flatnonzero(seen.inside)
    order = inside[np.argsort(seen.pixels[inside, 0], kind="stable")]
    columns = seen.pixels[order, 0]
    for k, box in enumerate(boxes):
        size = (box[2:] - box[:2]) * 0.15 + 2
        first, last = np.searchsorted(columns, [box[0] - size[0], box[2] + size[0]], side="left")
        near = order[first:last]
        v = seen.pixels[near, 1]
        near = near[(v >= box[1] - size[1]) & (v <= box[3] + size[1])]
        inner = _within(seen.pixels[near], box)
        rows = _foreground(seen, np.sort(near[inner]), near[~inner], mask_classes[k], background, s)
        found = _object(seen, rows, box, s)
        if found is not None:
            candidates.append(Lifted(k, found[0], shape_of(seen.points[found[0]], seen.up), found[1]))
    free = np.ones(len(seen.points), np.bool_)
    kept = []
    for each in sorted(candidates, key=lambda c: (-c.overlap, c.detection)):
        own = each.points[free[each.points]]
        if len(own) < s.min_points or len(own) < 0.5 * len(each.points):
            continue  # another box has it
        free[own] = False
        shape = each.shape if len(own) == len(each.points) else shape_of(seen.points[own], seen.up)
        kept.append(Lifted(each.detection, own, shape, each.overlap))
    return sorted(kept, key=lambda c: c.detection)


def _within(pixels: Array, box: Array) -> Mask:
    return np.asarray(((pixels >= box[:2]) & (pixels <= box[2:])).all(axis=1))


def _foreground(
    seen: Seen, rows: Indices, ring: Indices, wanted: int, background: Sequence[int], s: LiftSettings
) -> Indices:
    if seen.classes is not None and wanted >= 0:
        of_class = rows[seen.classes[rows] == wanted]
        if len(of_class) >= max(s.min_points, s.mask_share * len(rows)):
            return np.asarray(of_class)
    if seen.classes is not None:
        rows = rows[~np.isin(seen.classes[rows], background)]
    return _off_support(seen, rows, ring, s)


def _off_support(seen: Seen, rows: Indices, ring: Indices, s: LiftSettings) -> Indices:
    """Returns the points that are not on a level surface which goes on in the ring around the box."""
    if not len(rows) or len(ring) < s.min_points:
        return rows
    heights, around = seen.points[rows] @ seen.up, seen.points[ring] @ seen.up
    near = np.abs(np.linalg.norm(seen.points[ring], axis=1) - np.median(np.linalg.norm(seen.points[rows], axis=1))) < 1
    cells, counts = np.unique(np.floor(around[near] / s.slab).astype(np.int64), return_counts=True)
    level = cells[counts >= max(_FEWEST, 0.15 * len(ring))]
    mine = np.floor(heights / s.slab).astype(np.int64)
    kept = rows[~np.isin(mine, np.concatenate([level, level + 1]))] if len(level) else rows
    return kept if len(kept) >= s.min_points else rows


def _object(seen: Seen, rows: Indices, box: Array, s: LiftSettings) -> tuple[Indices, float] | None:
    """Returns the points of the object in a box and the overlap of their image with it."""
    if len(rows) < s.min_points:
        return None
    points = seen.points[rows]
    voxels = Voxels.by_size(points.astype(np.float32), s.voxel)
    middle = float(np.median(np.linalg.norm(points, axis=1)))
    labels = dbscan(voxels.means(points), s.reach + s.reach_growth * middle, _CORE, voxels.counts)[voxels.of]
    parts = [rows[labels == c] for c in range(int(labels.max(initial=-1)) + 1)]
    parts = [part for part in parts if len(part) >= _FEWEST]
    if not parts:
        return None
    values = [_image_overlap(seen, part, box) for part in parts]
    order = sorted(range(len(parts)), key=lambda c: (-values[c], c))
    chosen, value = parts[order[0]], values[order[0]]
    for c in order[1:]:
        both = np.concatenate([chosen, parts[c]])
        better = _image_overlap(seen, both, box)
        if better > value + 0.01 and _apart(seen.points[chosen], seen.points[parts[c]]) <= s.gap:
            chosen, value = both, better
    if value < s.min_overlap or len(chosen) < s.min_points:
        return None
    return np.sort(chosen), value


def _image_overlap(seen: Seen, rows: Indices, box: Array) -> float:
    uv = np.sort(seen.pixels[rows], axis=0)
    cut = len(rows) // 100  # one in a hundred may stray
    own = np.concatenate([uv[cut], uv[len(rows) - 1 - cut]])
    return float(overlap(own[None], box[None])[0, 0])


def _apart(first: Array, second: Array) -> float:
    """Returns the gap between the axis-parallel boxes of two groups of points."""
    gap = np.maximum(first.min(axis=0) - second.max(axis=0), second.min(axis=0) - first.max(axis=0))
    return float(np.linalg.norm(np.maximum(gap, 0)))
