"""Rates whether an observation is of an object of the map, by place, image, class and colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.cuboid import ImageView, image_boxes
from operators.scene.map.map_object import MapObject
from operators.scene.map.voxels import VoxelSet, standing_box
from operators.tracking.assignment import overlap

Array = NDArray[np.float64]
Pair = tuple[float, float]
LARGE = 0.8  # metres on the ground from which a thing is seldom seen whole, so that its voxels tell
_COARSE = 0.3  # metres from which a thing is often hidden in part
_WITHIN = 0.8  # share of an image box that is in that of an object, where the rest is hidden
_COVERING = 0.6  # share of the smaller of two image boxes, from which one covers the other
_TRACKED = 0.5  # by which what may be an object, and is of its track, is likelier it
_SLACK = 0.02  # of the distance, by which points stray


@dataclass(frozen=True)
class MapSettings:
    """Lengths in metres, times in seconds, evidence in log odds; noise of ranges at one metre, grows by the square.

    `label` is the mean of what labels of its class count, over its views, below which a small thing that moves or is
    carried is doubted: other things are often called so, but not surely.
    """

    voxel: float = 0.03
    margin: float = 0.1
    overlap: float = 0.25
    image_overlap: float = 0.3
    confirm: float = 1.25
    views: int = 3
    vacated: float = 1.0
    missed: float = 0.12
    miss_angle: float = 0.03
    gain: float = 0.3
    label: float = 0.35
    reach: float = 0.12
    range_noise: float = 0.0012
    mover_reach: float = 0.5
    mover_speed: float = 1.5
    mover_memory: float = 8.0
    move_memory: float = 120.0


@dataclass(frozen=True, eq=False)
class Observation:
    """One object as seen once: points (N, 3) in the world, class, score, and mean colour (3,) in [0, 1] if known.

    `image` is what the image shows of it, where there is one; those of one time share `P`. `track` is the id of its
    track in the images, -1 for none.
    """

    points: Array
    class_id: int
    score: float
    color: Array | None = None
    image: ImageView | None = None
    track: int = -1


def alike_mover(each: Observation, voxels: VoxelSet, object: MapObject, stamp: int, s: MapSettings) -> float:
    """Returns how likely an observation is of a mover, by where that should be by now and its track; 0 for not."""
    if each.class_id != object.class_id:
        return 0.0
    since = (stamp - object.seen) * 1e-9
    center, _, _ = standing_box(voxels.points)
    away = center - object.center - object.velocity * min(since, 1.0)
    reach = s.mover_reach + s.mover_speed * min(since, 2.0)
    near = 1 - float(np.hypot(away[0], away[1])) / reach
    return near + (_TRACKED if each.track in object.tracks else 0.0) if near > 0 else 0.0


def alike(
    each: Observation, voxels: VoxelSet, object: MapObject, image: Pair | None, s: MapSettings, *, large: bool
) -> float:
    """Returns how likely an observation is of an object: in [0, 1], more if it is of its track, 0 where it is not.

    `image` has the IoU of its image with that of the object's box, and the share of the first that is in the second,
    where there is an image. `large` things are seldom seen whole: their voxels decide.
    """
    iou, within = (math.nan, math.nan) if image is None else image
    away = outside(voxels.middle, object.box)
    reach = s.reach if each.image is None else s.reach + _SLACK * float(np.linalg.norm(voxels.middle - each.image.eye))
    if away > reach:
        return 0.0
    if each.class_id != object.class_id:
        if image is not None:
            return 0.5 * iou if iou >= 0.6 else 0.0
        if float(np.abs(object.size - voxels.extent).max()) > 0.5 * float(object.size.max()):
            return 0.0
        share = min(object.voxels.near(voxels.points, s.voxel), voxels.near(object.voxels.points, s.voxel))
        return 0.5 * share if share >= 0.5 else 0.0
    value = 0.3 * (1 - away / reach) + 0.1 * color_likeness(each.color, object.color)
    value += _TRACKED if each.track in object.tracks else 0.0
    if iou >= s.image_overlap:
        return value + 0.6 * iou
    if image is not None and not large:  # what is hidden in part shows in part of its box
        return value + 0.2 * within if within >= _WITHIN and float(object.size.max()) >= _COARSE else 0.0
    share = object.voxels.near(voxels.points, tolerance(voxels.extent))
    if image is None and not large:
        value *= closeness(voxels, object.voxels)
    return value + 0.3 * share if share >= s.overlap else 0.0


def in_reach(seen: Sequence[Observation], voxels: Sequence[VoxelSet], rows: Array, s: MapSettings) -> NDArray[np.bool_]:
    """Returns which of the observations (N) are near enough to boxes (M, 7), centre, size, heading, to be `alike`.

    A micrometre more passes: `alike` decides.
    """
    middles = np.array([each.middle for each in voxels])
    eyes = [middle if each.image is None else each.image.eye for each, middle in zip(seen, middles, strict=True)]
    reach = s.reach + _SLACK * np.sqrt(np.square(middles - np.array(eyes)).sum(axis=1))
    x, y, z = middles.T[..., None] - rows.T[:3, None]
    cos, sin = np.cos(rows[:, 6]), np.sin(rows[:, 6])
    gaps = np.stack([np.abs(cos * x + sin * y), np.abs(cos * y - sin * x), np.abs(z)]) - rows.T[3:6, None] / 2
    gaps = np.maximum(gaps, 0)
    return np.asarray((gaps * gaps).sum(axis=0) <= np.square(reach + 1e-6)[:, None])


def in_image(seen: Sequence[Observation], rows: Array, rounded: NDArray[np.bool_]) -> Array | None:
    """Returns the IoUs of the images of observations (N) and boxes (M, 7), some of round things, and the shares of the
    first in the second (N, M, 2); None without images."""
    if not len(rows) or any(each.image is None for each in seen):
        return None
    images = [each.image for each in seen if each.image is not None]
    boxes = np.stack([image.box for image in images])
    known = image_boxes(rows, images[0].P, rounded)
    beyond = ~np.stack([image.edges for image in images])
    for k, edge in np.argwhere(beyond).tolist():  # what reaches beyond the image is cut off there
        cut = np.maximum if edge < 2 else np.minimum
        known[:, edge % 2 :: 2] = cut(known[:, edge % 2 :: 2], boxes[k, edge])
    iou = np.nan_to_num(overlap(boxes, known))
    low = np.maximum(boxes[:, None, :2], known[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], known[None, :, 2:])
    areas = np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-6).prod(axis=1)
    within = np.nan_to_num(np.maximum(high - low, 0).prod(axis=2) / areas[:, None])
    return np.stack([iou, within], axis=2)


def in_places_of_their_own(images: Sequence[ImageView]) -> NDArray[np.bool_]:
    """Returns of each two of images of one view (N, N) whether neither covers the other's place."""
    boxes = np.stack([image.box for image in images])
    low, high = (side(boxes[:, None], boxes[None]) for side in (np.maximum, np.minimum))
    shared = np.maximum(high[..., 2:] - low[..., :2], 0).prod(axis=2)
    areas = np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-6).prod(axis=1)
    return np.asarray(shared < _COVERING * np.minimum(areas[:, None], areas[None]))


def outside(place: Array, box: tuple[Array, Array, float]) -> float:
    """Returns how far a place (3,) is from a box, 0 inside."""
    center, size, yaw = box
    c, s = math.cos(yaw), math.sin(yaw)
    x, y, z = (place - center).tolist()
    w, d, h = (size / 2).tolist()
    gaps = (max(abs(c * x + s * y) - w, 0.0), max(abs(c * y - s * x) - d, 0.0), max(abs(z) - h, 0.0))
    return math.sqrt(sum(g * g for g in gaps))


def tolerance(extent: Array) -> float:
    """Returns how near points of one object are: a third of its middle extent, so that rows of books stay apart."""
    return float(np.clip(0.35 * np.sort(extent)[1], 0.015, 0.12))


def closeness(voxels: VoxelSet, known: VoxelSet) -> float:
    """Returns 1 for small things whose middles agree, 0 for ones a middle extent apart; 0.5 for what may be a part."""
    extent = np.sort(voxels.extent)
    if extent[2] > 0.4:
        return 0.5
    away = float(np.linalg.norm(voxels.middle - known.middle))
    return max(0.0, 1 - away / (max(float(extent[1]), 0.03) + 0.02))


def color_likeness(first: Array | None, second: Array) -> float:
    """Returns 1 for equal mean colours, 0 for ones half the scale apart; a half where one is not known."""
    if first is None or not np.isfinite(second).all():
        return 0.5
    return max(0.0, 1 - 2 * float(np.abs(first - second).max()))
