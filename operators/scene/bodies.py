"""Nodes as upright boxes in space, and what pairs of them have in common."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Body:
    """A node: centre (3,), full size (3,) and heading of its upright box, and its velocity (3,), m/s."""

    id: int
    label: str
    center: Array
    size: Array
    yaw: float
    velocity: Array
    agent: bool = False

    @cached_property
    def bottom(self) -> float:
        return float(self.center[2] - self.size[2] / 2)

    @cached_property
    def top(self) -> float:
        return float(self.center[2] + self.size[2] / 2)

    @cached_property
    def volume(self) -> float:
        width, depth, height = self.size.tolist()
        return float(width * depth * height)

    @cached_property
    def outline(self) -> NDArray[np.float32]:
        """The corners (4, 2) as OpenCV takes them."""
        return self._corners.astype(np.float32)

    def corners(self) -> Array:
        """Returns the four corners (4, 2) of the footprint, counter-clockwise."""
        return self._corners

    @cached_property
    def _corners(self) -> Array:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * self.size[:2] / 2
        return np.asarray(half @ np.array([[c, s], [-s, c]]) + self.center[:2])


def footprint_share(first: Body, second: Body) -> float:
    """Returns the share of the first footprint's area that lies on the second."""
    a, b = first.outline, second.outline
    area = float(first.size[0] * first.size[1])
    if area < 1e-6:
        return float(cv2.pointPolygonTest(b, (float(first.center[0]), float(first.center[1])), False) >= 0)
    return float(min(cv2.intersectConvexConvex(a, b)[0] / area, 1.0))


def gap(first: Body, second: Body) -> float:
    """Returns the distance between two boxes, 0 where they touch."""
    vertical = max(0.0, first.bottom - second.top, second.bottom - first.top)
    a, b = first.outline, second.outline
    if cv2.intersectConvexConvex(a, b)[0] > 0:
        return vertical
    level = min(
        *(abs(cv2.pointPolygonTest(b, corner, True)) for corner in a.tolist()),
        *(abs(cv2.pointPolygonTest(a, corner, True)) for corner in b.tolist()),
    )
    return float(np.hypot(level, vertical))


class BoxPairs:
    """Shares and gaps of pairs of bodies, worked out once for as long as both stay where they are."""

    def __init__(self) -> None:
        self._boxes: dict[int, tuple[bytes, int]] = {}
        self._shares: dict[tuple[int, int], tuple[int, int, float]] = {}
        self._gaps: dict[tuple[int, int], tuple[int, int, float]] = {}
        self._count = 0

    def update(self, bodies: Iterable[Body]) -> None:
        """Takes where the bodies are now; what is kept of those that are gone goes."""
        before, self._boxes = self._boxes, {}
        for body in bodies:
            box = body.center.tobytes() + body.size.tobytes() + np.float64(body.yaw).tobytes()
            old = before.get(body.id)
            if old is None or old[0] != box:
                self._count += 1
                old = (box, self._count)
            self._boxes[body.id] = old
        if len(self._boxes) < len(before):
            for table in (self._shares, self._gaps):
                for pair in [p for p in table if p[0] not in self._boxes or p[1] not in self._boxes]:
                    del table[pair]

    def share(self, first: Body, second: Body) -> float:
        """Returns the share of the first footprint's area that lies on the second."""
        a, b = self._boxes[first.id][1], self._boxes[second.id][1]
        known = self._shares.get((first.id, second.id))
        if known is None or known[0] != a or known[1] != b:
            known = (a, b, footprint_share(first, second))
            self._shares[first.id, second.id] = known
        return known[2]

    def gap(self, first: Body, second: Body) -> float:
        """Returns the distance between two boxes, 0 where they touch."""
        a, b = self._boxes[first.id][1], self._boxes[second.id][1]
        known = self._gaps.get((first.id, second.id))
        if known is None or known[0] != a or known[1] != b:
            known = (a, b, gap(first, second))
            self._gaps[first.id, second.id] = known
        return known[2]
