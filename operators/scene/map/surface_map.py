"""The map of surfaces: floor, walls, table tops, joined over time by their planes and by where they lie."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.map_surface import FLOOR, SIDE, MapSurface
from operators.scene.map.range_view import RangeView
from operators.scene.map.trajectory import Correction
from operators.scene.map.voxels import VoxelSet

Array = NDArray[np.float64]

_MARGIN = 0.15  # metres in front of a surface that count as it
_TURN = math.cos(math.radians(12))  # of the angle between parts of one wall
_AWAY = 0.1  # metres of one part from the plane of another; floors, of which there is one, twice that
_REACH = {True: 0.25, False: 0.6}  # metres between parts of one level and of one upright surface
_TOUCHING = 3  # voxels of a part that come so near to the other
_GAIN = 0.8  # evidence of a view
_VACATED = 1.5  # evidence that a view takes which looks through it
_LEFT = 0.35  # share of the voxels that remains of what is there
_FORGOTTEN = 20_000_000_000  # nanoseconds after which a surface goes that was seen too seldom


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """A part of a surface as seen once, in the map: its class, the side that it faces (3,), and points (N, 3)."""

    label: str
    facing: Array
    points: Array


class SurfaceMap:
    """Joins the planes of views to surfaces, and drops those that views look through.

    Two planes of a class are one surface where they face one side, the smaller lies on the plane of the larger, and
    their voxels come near each other. There is one floor. Everything is kept while it is out of sight. `confirmed` are
    the surfaces that are surely there, by rising id.
    """

    def __init__(self, views: int = 2, min_area: float = 0.25) -> None:
        """Surfaces are given once `views` have shown `min_area` (m²) of them."""
        self._views, self._min_area = views, min_area
        self.surfaces: dict[int, MapSurface] = {}
        self.confirmed: list[MapSurface] = []
        self._next = 1

    def update(self, stamp: int, seen: Sequence[SeenSurface], view: RangeView, heading: float | None = None) -> None:
        """Takes the surfaces of one time and the view that they come from.

        `heading` is that of most things around.
        """
        shown: list[int] = []
        for each in seen:
            part = MapSurface(
                self._next, each.label, VoxelSet.of(each.points, SIDE, stamp), each.facing, _GAIN, stamp, stamp
            )
            part.most = len(part.voxels)
            known = self._best(part)
            if known is None:
                self.surfaces[part.id] = part
                self._next += 1
                shown.append(part.id)
                continue
            again = known.id in shown  # in this view
            known.take(part)
            known.views -= again
            shown.append(known.id)
        self._join(shown)
        self._look_around(view, set(shown))
        for i, surface in list(self.surfaces.items()):
            seldom = surface.views < self._views and stamp - surface.seen > _FORGOTTEN
            if surface.evidence < 0 or seldom or not len(surface.voxels):
                del self.surfaces[i]
        rows = [s for _, s in sorted(self.surfaces.items()) if s.views >= self._views]
        self.confirmed = [s for s in rows if s.area >= self._min_area]
        for surface in self.confirmed:
            surface.settle(heading)

    def correct(self, correction: Correction, heading: float | None = None) -> None:
        """Moves all surfaces with the places from which they were seen; those that come to be the same are one."""
        for surface in self.surfaces.values():
            surface.correct(correction)
        self._join(sorted(self.surfaces))
        self.confirmed = [s for s in self.confirmed if self.surfaces.get(s.id) is s]
        for surface in self.confirmed:
            surface.settle(heading)

    @property
    def floor(self) -> float | None:
        """Height of the floor; None where it is not known."""
        floors = [s for s in self.confirmed if s.label == FLOOR]
        return float(floors[0].middle[2]) if floors else None

    def _best(self, part: MapSurface) -> MapSurface | None:
        """Returns the known surface that a part is of, the one with most voxels near it."""
        near = [(count, -s.id) for s in self.surfaces.values() if (count := shared(s, part))]
        return self.surfaces[-max(near)[1]] if near else None

    def _join(self, changed: Sequence[int]) -> None:
        """Makes one of surfaces that have come to be the same: the older one stays."""
        for i in changed:
            for j in sorted(self.surfaces):
                if i != j and i in self.surfaces and shared(self.surfaces[i], self.surfaces[j]):
                    kept, other = min(i, j), max(i, j)
                    self.surfaces[kept].take(self.surfaces.pop(other))

    def _look_around(self, view: RangeView, shown: set[int]) -> None:
        """Takes voxels from surfaces that the view looks through, and evidence from those that it does not show."""
        others = [s for i, s in self.surfaces.items() if i not in shown and s.label != FLOOR]
        sights = view.of_each([s.voxels.points for s in others], _MARGIN)
        for surface, sight in zip(others, sights, strict=True):
            if int(np.count_nonzero(sight.looked)) < sight.least:
                continue
            surface.voxels.carve(sight.free)
            if sight.is_empty:
                surface.evidence -= _VACATED
            if len(surface.voxels) < _LEFT * surface.most:
                surface.evidence = -1.0
            elif len(surface.voxels):
                surface.fit()

    # snapshot and restore are written out: saved maps hold what they give, and those of earlier versions are read

    def snapshot(self) -> dict[str, Any]:
        surfaces = [s.snapshot() for s in self.surfaces.values()]
        return {"next": self._next, "surfaces": surfaces, "confirmed": [s.id for s in self.confirmed]}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._next = int(state["next"])
        surfaces = [MapSurface.restored(row) for row in state["surfaces"]]
        self.surfaces = {s.id: s for s in surfaces}
        self.confirmed = [self.surfaces[int(i)] for i in state["confirmed"]]


def shared(first: MapSurface, second: MapSurface) -> int:
    """Returns how many voxels of the smaller come near the other where both are one surface, else 0."""
    if first.label != second.label or float(first.normal @ second.normal) < _TURN:
        return 0
    large, small = (first, second) if len(first.voxels) >= len(second.voxels) else (second, first)
    limit = 2 * _AWAY if large.label == FLOOR else _AWAY
    if not len(small.voxels) or large.away(small.voxels.points) > limit:
        return 0
    if large.label == FLOOR:
        return len(small.voxels)
    reach = _REACH[large.level]
    if large.voxels.apart(small.voxels) > reach:
        return 0
    apart, _ = large.voxels.tree().query(small.voxels.points, distance_upper_bound=reach)
    near = int(np.count_nonzero(np.isfinite(apart)))
    return near if near >= min(_TOUCHING, len(small.voxels)) else 0
