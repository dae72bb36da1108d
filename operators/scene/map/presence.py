"""Evidence in a view of whether an object is still where it was."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.map_object import MOST_EVIDENCE, WHOLE, MapObject
from operators.scene.map.matching import MapSettings
from operators.scene.map.range_view import EMPTY, GROWTH, RangeView, Sight
from operators.scene.map.voxels import VoxelSet

Array = NDArray[np.float64]

_SELDOM = 3  # one view in so many is used to remove voxels of other objects
_LEFT = 0.35  # what is left of an object that is seen through: the foot of its place, which the floor confirms
_STRAY, _NOISES = 0.03, 3.0  # metres, and standard deviations of ranges, by which voxels stray from a surface


def has_left(object: MapObject, view: RangeView, s: MapSettings) -> bool:
    """Returns whether a view looks through the place of an object, as finely as its ranges allow.

    What a small thing stood on is not far behind it: less than the margin that is safe for all.
    """
    away = float(np.linalg.norm(object.center - view.origin))
    margin = min(s.margin + GROWTH * away, _STRAY + _NOISES * s.range_noise * away * away)
    return view.of(object.voxels.points, margin, 0.0).is_empty


def look_at(
    object: MapObject,
    sight: Sight | None,
    eye: Array,
    own: VoxelSet | None,
    seconds: float,
    priors: ClassPriors,
    s: MapSettings,
    *,
    left: bool,
) -> None:
    """Updates an object by what a view shows at its place, and by its voxels in the view (`own`), if any.

    `seconds` is the time since the view before: a view soon after it weighs less. `left` marks an object whose place a
    finer look found empty.
    """
    mover = priors.is_mover(object)
    if not len(object.voxels):
        object.evidence = -1.0
        return
    if not mover and sight is not None:
        if own is not None and object.views % _SELDOM == 0:
            object.voxels.doubt(sight.confirmed, own, _SELDOM)
        object.voxels.carve(sight.free)
        object.most = max(object.most, len(object.voxels))
    if own is not None:
        return
    if len(object.voxels) < _LEFT * object.most:
        object.evidence = -1.0
    if mover:
        object.evidence -= seconds * MOST_EVIDENCE / s.mover_memory
    if sight is None:
        return
    share = min(seconds * 1e9 / WHOLE, 1.0)
    if left or sight.is_empty:
        object.evidence -= share * s.vacated * (3 if mover else 1)
    elif np.count_nonzero(sight.looked) >= sight.least:
        distance = float(np.linalg.norm(object.center - eye))
        plain = np.count_nonzero(sight.confirmed) >= EMPTY * len(sight.looked)
        if plain and object.longest >= s.miss_angle * distance:
            object.evidence -= share * s.missed
