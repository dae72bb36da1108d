"""The predicates of the true scene graph, and the thresholds of those that are a matter of degree.

Placement and contact come from what was done in the world: what was put on or into what, who sits on what, what a hand
holds. No distance decides them. `near`, `left_of` and `in_front_of` have no such origin; their thresholds stand here
and nowhere else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from operators.simulator.scene import Relation, Thing

Array = NDArray[np.float64]

PLACEMENT = ("on", "in", "sitting_on", "holding", "reaching_for")
"""`on`: stands or lies on it. `in`: stands in one of its compartments. `holding`: the subject's hand has the object."""

SPATIAL = ("near", "left_of", "in_front_of")

NEAR = 0.5
"""`near`: the gap between the two surfaces (nearest vertices) is at most this, metres. Given once, lower id first."""

SIDE = 0.15
"""`left_of`, `in_front_of`: near things whose middles differ by at least this in the robot's eyes, metres.

The larger of the two differences, along the robot's y (left) and x (front), decides: a is left_of b when its y is
larger; a is in_front_of b, nearer to the robot, when its x is smaller.
"""


class Nearness:
    """Finds things that are near each other; pairs of things that stand still are worked out once."""

    def __init__(self, things: list[Thing]) -> None:
        self._things = things
        self._still = [thing for thing in things if thing.still]
        self._clouds = {thing.id: _Cloud(thing.vertices(0.0)) for thing in self._still}
        self._fixed = [
            (a.id, b.id)
            for k, a in enumerate(self._still)
            for b in self._still[k + 1 :]
            if self._clouds[a.id].near(self._clouds[b.id])
        ]

    def pairs(self, t: float) -> list[tuple[int, int]]:
        """(lower id, higher id), sorted."""
        clouds = dict(self._clouds)
        movers = [thing for thing in self._things if not thing.still]
        for thing in movers:
            clouds[thing.id] = _Cloud(thing.vertices(t))
        moving = {thing.id for thing in movers}
        fresh = [
            (min(a, b), max(a, b))
            for a in sorted(moving)
            for b in clouds
            if a != b and not (b in moving and b < a) and clouds[a].near(clouds[b])
        ]
        return sorted([(min(p), max(p)) for p in self._fixed] + fresh)


class _Cloud:
    def __init__(self, vertices: Array) -> None:
        self.vertices = vertices
        self.low, self.high = vertices.min(axis=0), vertices.max(axis=0)
        self._tree: cKDTree | None = None

    def near(self, other: _Cloud) -> bool:
        gap = np.maximum(0, np.maximum(self.low - other.high, other.low - self.high))
        if float(gap @ gap) > NEAR * NEAR:
            return False
        if self._tree is None:
            self._tree = cKDTree(self.vertices)
        distance, _ = self._tree.query(other.vertices, distance_upper_bound=NEAR + 1e-9)
        return bool(np.min(distance) <= NEAR)


def spatial(pairs: list[tuple[int, int]], middles: dict[int, Array], T_world_base: Array) -> list[Relation]:
    """The relations of degree among things near each other, as the robot at `T_world_base` sees them."""
    relations = []
    left = T_world_base[:3, 1]
    front = T_world_base[:3, 0]
    for a, b in pairs:
        relations.append(Relation(a, "near", b))
        offset = middles[a] - middles[b]
        y, x = float(offset @ left), float(offset @ front)
        if max(abs(x), abs(y)) < SIDE:
            continue
        if abs(y) >= abs(x):
            relations.append(Relation(a, "left_of", b) if y > 0 else Relation(b, "left_of", a))
        else:
            relations.append(Relation(a, "in_front_of", b) if x < 0 else Relation(b, "in_front_of", a))
    return relations
