"""Classifies places by one cloud: seen through, confirmed, hidden, or not looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FAR = 1 << 30
GROWTH = 0.02  # share of the range by which the margin grows that is safe for all
EMPTY = 0.6  # share of the places looked at, from which they are as a whole what these are
_WIDER = 2.0  # columns narrow towards the poles: at 60 degrees to half


@dataclass(frozen=True, eq=False)
class Sight:
    """Knowledge of places (N,): `looked` where a ray went that way; of these, `free` and `confirmed`."""

    looked: Mask
    free: Mask
    confirmed: Mask

    @property
    def least(self) -> float:
        """Least number of places looked at from which a view decides."""
        return max(5.0, 0.2 * len(self.looked))

    @property
    def is_empty(self) -> bool:
        """True where enough places are looked at and most of these are seen through."""
        looked = int(np.count_nonzero(self.looked))
        return looked >= self.least and int(np.count_nonzero(self.free)) >= EMPTY * looked


class RangeView:
    """The nearest and farthest return in each direction from a sensor: a depth camera or a lidar."""

    def __init__(self, points: Array, T_world_sensor: Array, angle: float) -> None:
        """Takes points (N, 3) in the sensor's frame; `angle` is the side of a direction's bin, radians."""
        self._T_sensor_world = invert(T_world_sensor)
        self._own, self._T_world_sensor = points, T_world_sensor
        self.origin = np.asarray(T_world_sensor, np.float64)[:3, 3]
        self._angle = angle
        column, row, ranges = self._directions(np.ascontiguousarray(points.T))
        self._first = np.array([column.min(initial=_FAR), row.min(initial=_FAR)])
        self._shape = (column.max(initial=-_FAR) - self._first[0] + 1, row.max(initial=-_FAR) - self._first[1] + 1)
        self._nearest, self._farthest = np.full(0, np.inf), np.zeros(0)
        if len(ranges):
            bins = (column - self._first[0]) * self._shape[1] + row - self._first[1]
            self._nearest = np.full(int(self._shape[0] * self._shape[1]), np.inf)
            self._farthest = np.zeros(len(self._nearest))
            np.minimum.at(self._nearest, bins, ranges)
            np.maximum.at(self._farthest, bins, ranges)
        self.reach = float(ranges.max(initial=0.0))

    def snapshot(self) -> dict[str, Any]:
        """Returns the view as plain values, without its points."""
        facts = {"T": self._T_world_sensor, "angle": self._angle, "first": self._first, "shape": list(self._shape)}
        return facts | {"nearest": self._nearest, "farthest": self._farthest, "reach": self.reach}

    @classmethod
    def restored(cls, state: Mapping[str, Any]) -> RangeView:
        """Returns a view of a snapshot, which has no points."""
        made = cls(np.zeros((0, 3)), np.array(state["T"], np.float64), float(state["angle"]))
        columns, rows = map(int, state["shape"])
        made._first, made._shape = np.array(state["first"]), (columns, rows)
        made._nearest, made._farthest = np.array(state["nearest"]), np.array(state["farthest"])
        made.reach = float(state["reach"])
        return made

    @property
    def points(self) -> Array:
        """The returns (N, 3) in the world."""
        return transform_points(self._T_world_sensor, self._own)

    def of(self, places: Array, margin: float, growth: float = GROWTH) -> Sight:
        """Classifies places (N, 3) in the world by the view, within a margin and a share of the range."""
        column, row, ranges = self._directions(self._in_sensor(places))
        if not len(self._nearest):
            none = np.zeros(len(places), np.bool_)
            return Sight(none, none, none)
        column, row = column - self._first[0], row - self._first[1]
        inside = (column >= 0) & (column < self._shape[0]) & (row >= 0) & (row < self._shape[1])
        bins = np.where(inside, column * self._shape[1] + row, 0)
        nearest, farthest = self._nearest[bins], self._farthest[bins]
        looked = inside & (farthest > 0)
        slack = margin + growth * ranges
        free = looked & (nearest > ranges + slack)
        confirmed = looked & (nearest <= ranges + slack) & (farthest >= ranges - slack)
        return Sight(looked, free, confirmed)

    def may_show(self, centers: Array, radii: Array) -> Mask:
        """Returns which spheres (N,) are at least partly in the directions and the range that the view covers."""
        column, row, ranges = self._directions(self._in_sensor(centers))
        if not len(self._nearest):
            return np.zeros(len(centers), np.bool_)
        more = np.ceil(np.arcsin(np.clip(radii / np.maximum(ranges, 1e-9), 0, 1)) / self._angle) * _WIDER
        across, up = column - self._first[0], row - self._first[1]
        turned = (across + more >= 0) & (across - more < self._shape[0])
        around = round(2 * np.pi / self._angle)
        for turn in (-around, around):  # behind the sensor directions begin anew
            turned |= (across + turn + more >= 0) & (across + turn - more < self._shape[0])
        raised = (up + more >= 0) & (up - more < self._shape[1])
        return np.asarray(((turned & raised) | (ranges <= radii)) & (ranges <= self.reach + radii))

    def of_each(self, places: Sequence[Array], margin: float) -> list[Sight]:
        """Returns the same of each of several sets of places."""
        if not places:
            return []
        whole = self.of(np.concatenate(places), margin)
        ends = np.cumsum([len(p) for p in places])[:-1]
        parts = (np.split(values, ends) for values in (whole.looked, whole.free, whole.confirmed))
        return [Sight(*part) for part in zip(*parts, strict=True)]

    def _in_sensor(self, places: Array) -> Array:
        """Returns places (N, 3) in the world by coordinate (3, N) in the sensor's frame."""
        R, t = self._T_sensor_world[:3, :3], self._T_sensor_world[:3, 3:]
        return np.ascontiguousarray((places @ R.T).T) + t

    def _directions(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Returns column, row and range (N,) of points by coordinate (3, N)."""
        x, y, z = points
        ranges = np.sqrt(x * x + z * z + y * y)
        around = np.arctan2(x, z)
        rise = np.arcsin((y / np.maximum(ranges, 1e-9)).clip(-1, 1))
        column = np.floor(around / self._angle).astype(np.int64)
        return column, np.floor(rise / self._angle).astype(np.int64), ranges
