"""Nodes as upright boxes in space, and what pairs of them have in common."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.labels import LabelSpace, SizePrior

Array = NDArray[np.float64]
_STILL = np.zeros(3)
_STILL.flags.writeable = False


@dataclass(frozen=True)
class Body:
    """A node: centre (3,), full size (3,) and heading of its upright box, velocity (3,), m/s, roles of its class.

    `usual` are the usual sizes of its class. `moving` is the probability that it moves, NaN where that is to be found
    from its places.
    """

    id: int
    label: str
    center: Array
    size: Array
    yaw: float
    velocity: Array
    roles: frozenset[str] = frozenset()
    moving: float = math.nan
    usual: tuple[SizePrior, ...] = ()

    @property
    def agent(self) -> bool:
        return "agent" in self.roles

    @property
    def person(self) -> bool:
        return "person" in self.roles

    @cached_property
    def bottom(self) -> float:
        return float(self.center[2] - self.size[2] / 2)

    @cached_property
    def top(self) -> float:
        return float(self.center[2] + self.size[2] / 2)

    @cached_property
    def height(self) -> float:
        """Height of the centre."""
        return float(self.center[2])

    @cached_property
    def radius(self) -> float:
        """Radius of the sphere around the box."""
        return float(np.linalg.norm(self.size)) / 2

    @cached_property
    def flat_radius(self) -> float:
        """Radius of the circle around the footprint."""
        return float(np.linalg.norm(self.size[:2])) / 2

    @cached_property
    def volume(self) -> float:
        width, depth, height = self.size.tolist()
        return float(width * depth * height)

    @cached_property
    def outline(self) -> NDArray[np.float32]:
        """The corners (4, 2) as OpenCV takes them."""
        return self._corners.astype(np.float32)

    def hidden_foot(self, ground: float) -> float:
        """Returns how surely it stands on ground at this height, m, and what is seen of it is no whole one.

        That is so where it is as high as such things are if it stands there, and far from that as it is seen, such as
        the back of a chair behind a table. 0 for classes of which no foot is hidden; of those that also stand elsewhere
        (small plants) what is seen may be a part of such a one.
        """
        foot = [each for each in self.usual if each.foot]
        seen = max((_likeness(each, self.top - self.bottom, part=not each.foot) for each in self.usual), default=0.0)
        return max((_likeness(each, self.top - ground) for each in foot), default=0.0) * (1 - seen)

    def corners(self) -> Array:
        """Returns the four corners (4, 2) of the footprint, counter-clockwise."""
        return self._corners

    @cached_property
    def _corners(self) -> Array:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * self.size[:2] / 2
        return np.asarray(half @ np.array([[c, s], [-s, c]]) + self.center[:2])


class BodyMemory:
    """Makes bodies of boxes; one whose box is as it was is the same body, so that what was worked out of it stays."""

    def __init__(self, labels: LabelSpace) -> None:
        self._labels = labels
        self._known: dict[int, tuple[str, bytes, Body]] = {}

    def update(
        self, ids: Sequence[int], labels: Sequence[str], centers: Array, sizes: Array, yaws: Array
    ) -> list[Body]:
        """Returns the bodies of one time: centres (N, 3), full sizes (N, 3), headings (N,); others are forgotten."""
        before, self._known = self._known, {}
        rows = np.column_stack([centers, sizes, yaws])
        for k, (id, label) in enumerate(zip(ids, labels, strict=True)):
            box = rows[k].tobytes()
            known = before.get(id)
            if known is None or known[:2] != (label, box):
                roles, usual = self._labels.roles(label), self._labels.sizes(label)
                box_of = centers[k].copy(), sizes[k].copy(), float(yaws[k])
                body = Body(id, label, *box_of, _STILL, roles, usual=usual)
                known = (label, box, body)
            self._known[id] = known
        return [body for _, _, body in self._known.values()]


def _likeness(usual: SizePrior, height: float, *, part: bool = False) -> float:
    """Returns the likelihood of a height, m, relative to the usual one's own; with `part` a lower one is as likely."""
    if height <= 0 or (part and height < usual.size[2]):
        return float(height > 0)
    return math.exp(-0.5 * (math.log(height / usual.size[2]) / usual.spread[2]) ** 2)


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


def upright_iou(first: tuple[Array, Array, float], second: tuple[Array, Array, float]) -> float:
    """Returns the IoU of two boxes, each (centre (3,), full size (3,), heading about the vertical in radians)."""
    shared = shared_volume(first, second)
    union = float(np.prod(first[1]) + np.prod(second[1])) - shared
    return shared / union if union > 0 else 0.0


def shared_volume(first: tuple[Array, Array, float], second: tuple[Array, Array, float]) -> float:
    """Returns the volume that two such boxes share, m³."""
    (c1, s1, y1), (c2, s2, y2) = first, second
    height = min(c1[2] + s1[2] / 2, c2[2] + s2[2] / 2) - max(c1[2] - s1[2] / 2, c2[2] - s2[2] / 2)
    if height <= 0:
        return 0.0
    kind, region = cv2.rotatedRectangleIntersection(
        ((0.0, 0.0), (float(s1[0]), float(s1[1])), float(np.degrees(y1))),
        ((float(c2[0] - c1[0]), float(c2[1] - c1[1])), (float(s2[0]), float(s2[1])), float(np.degrees(y2))),
    )
    if kind == cv2.INTERSECT_NONE or region is None or len(region) < 3:
        return 0.0
    return float(cv2.contourArea(cv2.convexHull(region))) * float(height)


class BoxPairs:
    """Shares and gaps of pairs of bodies, worked out once for as long as both stay where they are."""

    def __init__(self) -> None:
        self._boxes: dict[int, tuple[Body, bytes, int]] = {}
        self._shares: dict[tuple[int, int], tuple[int, int, float]] = {}
        self._gaps: dict[tuple[int, int], tuple[int, int, float]] = {}
        self._count = 0

    def update(self, bodies: Iterable[Body]) -> None:
        """Takes where the bodies are now; what is kept of those that are gone goes."""
        before, self._boxes = self._boxes, {}
        for body in bodies:
            old = before.get(body.id)
            if old is None or old[0] is not body:
                box = body.center.tobytes() + body.size.tobytes() + np.float64(body.yaw).tobytes()
                self._count += old is None or old[1] != box
                old = (body, box, self._count if old is None or old[1] != box else old[2])
            self._boxes[body.id] = old
        if len(self._boxes) < len(before):
            for table in (self._shares, self._gaps):
                for pair in [p for p in table if p[0] not in self._boxes or p[1] not in self._boxes]:
                    del table[pair]

    def share(self, first: Body, second: Body) -> float:
        """Returns the share of the first footprint's area that lies on the second."""
        a, b = self._boxes[first.id][2], self._boxes[second.id][2]
        known = self._shares.get((first.id, second.id))
        if known is None or known[0] != a or known[1] != b:
            known = (a, b, footprint_share(first, second))
            self._shares[first.id, second.id] = known
        return known[2]

    def gap(self, first: Body, second: Body) -> float:
        """Returns the distance between two boxes, 0 where they touch."""
        a, b = self._boxes[first.id][2], self._boxes[second.id][2]
        known = self._gaps.get((first.id, second.id))
        if known is None or known[0] != a or known[1] != b:
            known = (a, b, gap(first, second))
            self._gaps[first.id, second.id] = known
        return known[2]
