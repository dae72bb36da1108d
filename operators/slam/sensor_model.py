"""Declares what a map of places asks of a sensor: how its views differ, which look alike, how one lies to another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.slam.keyframe_graph import Node

V = TypeVar("V")  # what a keyframe keeps of its place
W = TypeVar("W", contravariant=True)

AGREE = (0.1, 0.05)  # metres and radians by which two sights of one surprise may differ

Moved = Callable[[Node[Any], Matrix, Matrix], Matrix]
"""Gives the covariance (6, 6) of the motion from a node to a pose of the same odometry with its covariance."""


@dataclass(frozen=True)
class PlaceSettings:
    """Settings of a map. Changes of view are as the sensor counts them: `Eyes.distance`."""

    spacing: float  # change of view between views of the map; half of that while it is searched for
    travel: float  # along the way between two views that a loop may join
    reach: float  # change of view at which a view may be met again where the map expects it
    same: float  # change of view below which a place needs no second view
    aside: float  # change of view at which a keyframe is measured against those a little before it
    beside: int  # views compared with, of those a little before
    near: int  # views compared with, of those that the map expects here
    alike: int  # views compared with, of those that look alike, wherever they are
    searched: int  # the same while the map is searched for
    likeness: float  # from which a view may be one seen before
    least: Matrix  # covariance (6, 6) of a sight besides its own: what is alike in all


class Sighting(Protocol):
    """Holds how a view was measured against a known one."""

    @property
    def T_known_seen(self) -> Matrix: ...
    @property
    def covariance(self) -> Matrix: ...  # (6, 6), right perturbation


class Eyes(Protocol[V]):
    """Compares views of one sensor."""

    def distance(self, T_a: Matrix, T_b: Matrix) -> float:
        """Returns how differently the sensor sees from two poses."""

    def sight(self, nodes: Mapping[int, Node[V]], known: int, seen: int, expected: bool) -> Sighting | str:
        """Measures a node against a known one, or returns why the result is not trusted.

        `expected`: the nodes' poses predict the result.
        """


class Index(Protocol[W]):
    """Finds views that look alike."""

    def add(self, key: int, view: W) -> None:
        """Takes a view; each key is given once."""

    def likeness(self, view: W) -> Mapping[int, float]:
        """Returns how much each view has in common with this one: about 1 for the same place, 0 for nothing."""


@dataclass(frozen=True, eq=False)
class UnexpectedView:
    """A sight that the map did not expect, of node `known` by node `seen`; it needs another that agrees."""

    seen: int
    known: int
    island: int
    T_map_odom: Matrix

    def agrees(self, known: int, number: int, new: Node[Any], T_map_odom: Matrix) -> bool:
        """Returns whether another surprise, of node `known` by a new one, agrees."""
        if self.island != new.island or (self.seen, self.known) == (number, known):
            return False
        return alike(self.T_map_odom @ new.T_odom, T_map_odom @ new.T_odom)


def alike(T_a: Matrix, T_b: Matrix) -> bool:
    """Returns whether two poses found for one view agree."""
    off = se3.log(invert(T_a) @ T_b)
    return bool(np.linalg.norm(off[:3]) < AGREE[0] and np.linalg.norm(off[3:]) < AGREE[1])


@dataclass(eq=False)
class KeyframeResult:
    """Holds the result for a keyframe: loops found from it, and why views that were compared with were refused."""

    node: bool = False
    loops: int = 0
    found: bool = False  # the map, from an island apart
    refused: list[str] = field(default_factory=list)
