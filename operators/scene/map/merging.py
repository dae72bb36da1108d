"""Entries of the map that are of one thing, what is made of them, and entries that stand in the place of others."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from operators.scene.bodies import shared_volume
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.map_object import MOST_EVIDENCE, MapObject
from operators.scene.map.matching import MapSettings, closeness, tolerance
from operators.scene.map.voxels import VoxelSet

_COVERED = 0.15  # share of the smaller of two boxes that both have, from which they are one
_APART_COVERED = 0.3  # that share where both are seen beside each other
_PART = 0.4  # that share where the classes differ
_LIKE = 6.0  # times smaller, and what is in the other is no part of it
_NEAR, _NEAR_MOVERS = 0.1, 0.3  # metres that the bounds of two entries of one thing are apart at most
_SELDOM = 0.15  # share of the views in which both are seen beside each other, from which they are two


def may_be_one(known: Sequence[MapObject], rows: NDArray[np.intp], priors: ClassPriors) -> NDArray[np.bool_]:
    """Returns of some entries (N,) of the map and all (M,) whether their bounds are near enough to be `are_one`'s."""
    low, high = (np.array([each.voxels.bounds[side] for each in known]).T for side in (0, 1))
    movers = np.array([priors.is_mover(each) for each in known])
    apart = np.maximum(low[:, rows, None], low[:, None]) - np.minimum(high[:, rows, None], high[:, None])
    return np.asarray(apart.max(axis=0) <= np.where(movers[rows, None] | movers, _NEAR_MOVERS, _NEAR))


def are_one(a: MapObject, b: MapObject, priors: ClassPriors, voxel: float) -> bool:
    """Returns whether two entries are of one thing: they share their place, and are seldom seen beside each other."""
    apart = a.voxels.apart(b.voxels)
    if apart > _NEAR_MOVERS:
        return False
    movers = priors.is_mover(a), priors.is_mover(b)
    if any(movers) and a.class_id != b.class_id and not (priors.is_still(a) and priors.is_still(b)):
        return False
    if not any(movers) and apart > _NEAR:
        return False
    if all(movers):
        return float(np.hypot(*(a.center - b.center)[:2])) < 0.3
    volumes = math.prod(a.size.tolist()), math.prod(b.size.tolist())
    beside = max(a.beside[b.id], b.beside[a.id]) > _SELDOM * min(a.views, b.views)
    both = shared_volume(a.box, b.box)
    shared = both / max(min(volumes), 1e-9)
    if a.class_id != b.class_id:
        if both > 0 and both / (sum(volumes) - both) >= 0.5:
            return True
        like = max(volumes) <= _LIKE * min(volumes) and not (priors.is_large(a) or priors.is_large(b))
        return like and not beside and shared >= _PART
    if shared >= (_APART_COVERED if beside else _COVERED):
        return True
    small, large = (a, b) if len(a.voxels) <= len(b.voxels) else (b, a)
    if a.images and b.images and not priors.is_large(small):
        return False
    if closeness(small.voxels, large.voxels) <= 0.3:
        return False
    return large.voxels.near(small.voxels.points, 0.5 * tolerance(small.size) + 0.5 * voxel) >= 0.5


def merge(a: MapObject, b: MapObject, priors: ClassPriors) -> MapObject:
    """Returns one entry for two: the older one's id, and the place of the one that was seen more often.

    Voxels and images of both count only where they are of one class; else those of a part would shrink the whole.
    """
    best, other = (a, b) if (a.views, -a.id) > (b.views, -b.id) else (b, a)
    if best.class_id == other.class_id and not priors.is_mover(best):
        best.voxels.add(other.voxels)
        for image in other.images:
            best.look(image)
    for class_id, count in enumerate(other.votes.tolist()):
        best.vote(class_id, count)
    best.evidence = min(max(best.evidence, other.evidence), MOST_EVIDENCE)
    earlier, later = sorted((other, best), key=lambda each: each.seen)
    best.tracks, latest = earlier.tracks, later.tracks
    best.follow(latest)
    best.seen, best.views = max(best.seen, other.seen), best.views + other.views
    best.told += other.told
    best.view = best.view + other.view
    best.beside += other.beside
    best.born, best.id = min((a.born, a.id), (b.born, b.id))
    return best


def smaller_in_place(
    object: MapObject, known: Iterable[MapObject], priors: ClassPriors, s: MapSettings
) -> list[VoxelSet]:
    """Returns the voxels of smaller things in the place of a large one that has images, as of a chair before a desk.

    Masks give a part of such things to what is behind them. Only sure entries of other classes count.
    """
    if not (object.images and priors.is_large(object)):
        return []
    return [
        o.voxels
        for o in known
        if o.class_id != object.class_id
        and o.evidence >= s.confirm
        and o.sightings >= s.views
        and o.voxels.apart(object.voxels) <= s.voxel
        and not (priors.is_mover(o) or priors.is_large(o))
    ]
