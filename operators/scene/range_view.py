"""What one cloud says of places: seen through, confirmed, hidden, or not looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROW = 1 << 16


@dataclass(frozen=True, eq=False)
class Sight:
    """What is known of places (N,): `looked` where a ray went that way; of these, `free` and `confirmed`."""

    looked: Mask
    free: Mask
    confirmed: Mask


class RangeView:
    """The nearest and farthest return in each direction from a sensor: a depth camera or a lidar."""

    def __init__(self, points: Array, T_world_sensor: Array, angle: float) -> None:
        """Takes points (N, 3) in the sensor's frame; `angle` is the side of a direction's bin, radians."""
        self._T_sensor_world = invert(T_world_sensor)
        self.origin = np.asarray(T_world_sensor, np.float64)[:3, 3]
        self._angle = angle
        keys, ranges = self._directions(points)
        order = np.lexsort((ranges, keys))
        keys, ranges = keys[order], ranges[order]
        self._keys, first = np.unique(keys, return_index=True)
        self._nearest = ranges[first] if len(first) else np.zeros(0)
        last = np.append(first[1:], len(keys)) - 1
        self._farthest = ranges[last] if len(first) else np.zeros(0)
        self.reach = float(ranges.max(initial=0.0))

    def of(self, places: Array, margin: float) -> Sight:
        """Tells what the view says of places (N, 3) in the world, within a margin and 2 % of the range."""
        keys, ranges = self._directions(transform_points(self._T_sensor_world, places))
        if not len(self._keys):
            none = np.zeros(len(places), np.bool_)
            return Sight(none, none, none)
        slot = np.searchsorted(self._keys, keys).clip(max=len(self._keys) - 1)
        looked = self._keys[slot] == keys
        slack = margin + 0.02 * ranges
        free = looked & (self._nearest[slot] > ranges + slack)
        confirmed = looked & (self._nearest[slot] <= ranges + slack) & (self._farthest[slot] >= ranges - slack)
        return Sight(looked, free, confirmed)

    def _directions(self, points: Array) -> tuple[NDArray[np.int64], Array]:
        ranges = np.linalg.norm(points, axis=1)
        around = np.arctan2(points[:, 0], points[:, 2])
        rise = np.arcsin(np.clip(points[:, 1] / np.maximum(ranges, 1e-9), -1, 1))
        column = np.floor(around / self._angle).astype(np.int64) + _ROW // 2
        row = np.floor(rise / self._angle).astype(np.int64) + _ROW // 2
        return column * _ROW + row, ranges
