"""Things in the hands of people: seen at somebody, and no longer where they lay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from operators.scene.map_object import MapObject

Array = NDArray[np.float64]

_ARM = 0.35  # metres beyond a body's box on the ground, up to which its hands are
_HAND = 0.55  # metres above the foot of a body from which its hands are
_REACH = 1.0  # metres on the ground that a hand takes a thing in a short while
_AWAY = 0.12  # metres from its place, from which a thing is carried


def in_hand(place: Array, bodies: Sequence[MapObject]) -> bool:
    """Tells whether a place (3,) is where one of these bodies has its hands."""
    for body in bodies:
        c, s = np.cos(body.yaw), np.sin(body.yaw)
        x, y, z = (place - body.center).tolist()
        beside = max(abs(c * x + s * y) - body.size[0] / 2, abs(c * y - s * x) - body.size[1] / 2)
        if beside <= _ARM and _HAND - body.size[2] / 2 <= z <= body.size[2] / 2 + 0.1:
            return True
    return False


def taken(place: Array, class_id: int, known: Mapping[int, MapObject], usable: Sequence[int]) -> int | None:
    """Returns the id of the thing of a class that is now in a hand at `place` (3,): the nearest one in reach.

    `usable` are the ids of things that the view should show and that are not seen where they lay.
    """
    ways = []
    for i in usable:
        object = known[i]
        way = object.center - place
        flat = float(np.hypot(way[0], way[1]))
        if object.class_id == class_id and flat <= _REACH and float(np.linalg.norm(way)) >= _AWAY:
            ways.append((flat, i))
    return min(ways)[1] if ways else None
