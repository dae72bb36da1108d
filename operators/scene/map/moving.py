"""Finds which large things move, by their places, which views show to be taken or empty."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.map_object import MapObject
from operators.scene.map.range_view import RangeView, Sight

Array = NDArray[np.float64]

_EVERY, _AGO, _LONG_AGO = 0.3, 0.6, 2.0  # seconds between the views kept, and how long ago the one to compare was
_MOVED = 0.4  # share of a place that is seen through now, or was before, of what is seen of it
_STEEP = 2.0  # of the probability by that share
_UNSURE = 0.1  # of the probability, off 0.5: knowledge fades to it before the centre counts


@dataclass(frozen=True, eq=False)
class _Moment:
    """One view, and the means (N, 3) of the voxels that large movers had in it, by id."""

    stamp: int
    view: RangeView
    places: Mapping[int, Array]


class RecentPlaces:
    """The last second of views and places of things that can move and are seldom seen whole.

    The centre of such a thing moves as the part of it that is in sight does. Where it stands, the place that it had a
    moment ago is taken now, and that which it has now was taken then or hidden; where it moves, much of the one is seen
    through now, or much of the other was then.
    """

    def __init__(self, margin: float) -> None:
        """Takes the distance up to which a return may stray, metres."""
        self._margin = margin
        self._moments: list[_Moment] = []

    def judge(self, stamp: int, movers: Sequence[MapObject], view: RangeView) -> None:
        """Sets `moving` of the movers of this view: 0.5 where that is hidden or nothing can be compared yet.

        It is NaN where no view looks at the places, as of a thing of a few voxels: the centre is all that is known of
        it. Earlier knowledge fades first.
        """
        kept = [m for m in self._moments if 0 <= stamp - m.stamp <= _LONG_AGO * 1e9]
        before = next((m for m in reversed(kept) if stamp - m.stamp >= _AGO * 1e9), None)
        for each in movers:
            told = 0.5 if before is None else _moved(each, before, view, self._margin)
            if math.isnan(told) and abs(each.moving - 0.5) > _UNSURE:
                told = 0.5
            each.moving = told if not each.moving >= 0 else (each.moving + told) / 2
        self._moments = [m for m in kept if before is None or m.stamp >= before.stamp]
        if movers and (not kept or stamp - kept[-1].stamp >= _EVERY * 1e9):
            self._moments.append(_Moment(stamp, view, {o.id: o.voxels.points for o in movers}))

    def forget(self) -> None:
        """Forgets the views: they are not where they were any more."""
        self._moments = []

    def snapshot(self) -> list[Any]:
        return [[m.stamp, m.view.snapshot(), [[i, points] for i, points in m.places.items()]] for m in self._moments]

    def restore(self, state: Iterable[Any]) -> None:
        self._moments = []
        for stamp, view, places in state:
            points = {int(i): np.array(each, np.float64) for i, each in places}
            self._moments.append(_Moment(int(stamp), RangeView.restored(view), points))


def _moved(object: MapObject, before: _Moment, view: RangeView, margin: float) -> float:
    """Returns the probability that an object has moved since a moment.

    0.5 where its places are hidden in the views, NaN where neither looks at them.
    """
    sights = [before.view.of(object.voxels.points, margin)]
    if object.id in before.places:
        sights.append(view.of(before.places[object.id], margin))
    shares = [share for share in map(_seen_through, sights) if share is not None]
    if not shares:
        return 0.5 if any(np.count_nonzero(sight.looked) >= sight.least for sight in sights) else math.nan
    return min(max(0.5 + _STEEP * (max(shares) - _MOVED), 0.02), 0.98)


def _seen_through(sight: Sight) -> float | None:
    """Returns the share of a place that is seen through, of what is seen of it; None where too little is."""
    free, taken = int(np.count_nonzero(sight.free)), int(np.count_nonzero(sight.confirmed))
    return None if free + taken < sight.least else free / (free + taken)
