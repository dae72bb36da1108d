"""A map of views whose poses are corrected when a camera comes back to where it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.fitting import Fitter
from operators.odometry.keyframe import Keyframe, view_distance
from operators.odometry.local_map import typical_depth
from operators.odometry.tracking import moved_covariance
from operators.slam.keyframe_graph import KeyframeGraph, Node
from operators.slam.place_index import PlaceIndex
from operators.slam.visual_view import Judge, Sight, View, sight

UNKNOWN = np.diag([1.0] * 3 + [1.0] * 3)  # covariance (6, 6) of a motion that nothing measured, m² and rad²
DRIFT = np.diag([0.002**2] * 3 + [0.001**2] * 3)  # what odometry may be off besides: it errs more where things move
LEAST = np.diag([0.0005**2] * 3 + [0.0003**2] * 3)  # of a sight: calibration errs alike in all
BESIDE = 0.6  # radians of view change at which a keyframe is measured against those a little before it
WINDOW = 10  # newest keyframes, which are settled at every new one
STRAIN = 12.6  # squared sigmas (95 % of 6 degrees of freedom) by which a loop may be off before the whole map moves
FAR = 30.0  # squared sigmas by which a sight may be off before it is a surprise
REACH = 0.7  # radians of view change at which a view may be met again where the map expects it
SAME = 0.12  # radians of view change below which a place needs no second view
ALIKE = 0.05  # likeness from which a view may be one seen before
AGREE = (0.1, 0.05)  # metres and radians by which two sights of one surprise may differ


@dataclass(frozen=True)
class GraphSettings:
    """Settings of a map; angles are of view: rotation plus baseline over depth, radians."""

    spacing: float = 0.2  # between views of the map; half of that while it is searched for
    travel: float = 1.5  # along the way between two views that a loop may join
    beside: int = 2  # views compared with, of those a little before
    near: int = 2  # views compared with, of those that the map expects here
    alike: int = 2  # and of those that look alike, wherever they are; twice as many while the map is searched for
    judge: Judge = field(default_factory=Judge)


@dataclass(frozen=True, eq=False)
class Surprise:
    """A sight that the map did not expect, of node `known` by node `seen`; it needs another that says the same."""

    seen: int
    known: int
    island: int
    T_map_odom: Matrix

    def agrees(self, known: int, number: int, new: Node, T_map_odom: Matrix) -> bool:
        """Tells whether another surprise, of node `known` by a new one, says the same."""
        if self.island != new.island or (self.seen, self.known) == (number, known):
            return False
        off = se3.log(invert(self.T_map_odom @ new.T_odom) @ T_map_odom @ new.T_odom)
        return bool(np.linalg.norm(off[:3]) < AGREE[0] and np.linalg.norm(off[3:]) < AGREE[1])


@dataclass(eq=False)
class Added:
    """Tells what became of a keyframe: loops found from it, and why views that were compared with were refused."""

    node: bool = False
    loops: int = 0
    found: bool = False  # the map, from an island apart
    refused: list[str] = field(default_factory=list)


class VisualGraph:
    """Keyframes, motions between neighbours by odometry and by sight, and loops between views of one place.

    A chain of odometry that is broken begins an island. The first is the map, unless a map was loaded; others are tied
    to it by the first loops between them, two of which must agree.
    """

    def __init__(self, settings: GraphSettings) -> None:
        self._settings = settings
        self.graph = KeyframeGraph()
        self.T_map_odom: Matrix = np.eye(4)
        self.tied: set[int] = {0}  # islands whose place in the map is known
        self.islands = 0  # begun so far
        self.segments: dict[int, int] = {}  # the odometry's segments' islands
        self.surprises: list[Surprise] = []
        self.loops = 0
        self._index = PlaceIndex()

    @property
    def nodes(self) -> dict[int, Node]:
        return self.graph.nodes

    @property
    def newest(self) -> Node | None:
        """The newest keyframe that was seen, and not loaded."""
        return self.nodes[self.graph.newest] if self.islands else None

    @property
    def located(self) -> bool:
        """Tells whether the newest keyframe's place in the map is known."""
        newest = self.newest
        return (newest.island if newest else 0) in self.tied

    def begin_in(self, saved: Sequence[Node]) -> None:
        """Begins with a saved map, in which the camera is to be found; its nodes never move."""
        self.graph.begin_with(saved)
        self.tied = {node.island for node in saved}
        self.index_views()

    def index_views(self) -> None:
        """Makes the place index of the nodes' views."""
        self._index = PlaceIndex()
        for k, node in self.nodes.items():
            if node.view is not None:
                self._index.add(k, node.view.words)

    # -- growth ------------------------------------------------------------------------------------------

    def add(self, keyframe: Keyframe, fitter: Fitter, found_again: bool) -> Added:
        """Takes a keyframe of the odometry, and what fits its poses.

        `found_again` says that the odometry has found its own map again, so that its pose jumped.
        """
        last = self.newest
        island = self._island(keyframe)
        depth = typical_depth(keyframe.surface)
        broken = last is None or island != last.island or found_again
        moved = 0.0
        if last is not None and not broken:
            moved = view_distance(last.T_odom, keyframe.T_world_camera, depth)
            if moved < self._settings.spacing * (1.0 if self.located else 0.5):
                return Added()
        before = self.graph.newest if last is not None else None
        new = Node(
            stamp=keyframe.stamp, T_odom=keyframe.T_world_camera, covariance_odom=keyframe.covariance,
            T=self.T_map_odom @ keyframe.T_world_camera, covariance=keyframe.covariance,
            travel=(last.travel if last else 0.0) + (self._settings.travel if broken else moved),
            island=island, view=View.of(keyframe, fitter.camera),
        )  # fmt: skip
        number = self.graph.add(new)
        if before is not None:
            self._chain(before, number, broken)
        added = Added(node=True)
        self._look(number, fitter, depth, added)
        if not added.loops and self._beside(number, fitter, depth):
            self.graph.settle(WINDOW)
        self.T_map_odom = se3.orthonormalised(new.T @ invert(new.T_odom))
        if new.view is not None:
            self._index.add(number, new.view.words)
        for k in [k for k, node in self.nodes.items() if node.view is None and k <= number - WINDOW]:
            self.graph.retire(k)
        return added

    def _island(self, keyframe: Keyframe) -> int:
        """Returns the island of a keyframe: that of its segment, or a new one for a segment that is new."""
        if keyframe.segment not in self.segments or keyframe.segment > max(self.segments):
            self.segments[keyframe.segment] = self.islands
            self.islands += 1
        else:  # segments above it were joined to it, or dropped
            self.segments = {s: i for s, i in self.segments.items() if s <= keyframe.segment}
        return self.segments[keyframe.segment]

    def _chain(self, last: int, number: int, broken: bool) -> None:
        """Ties a new node to its island, by odometry."""
        new, before = self.nodes[number], last
        if broken:
            T = invert(self.nodes[last].T_odom) @ new.T_odom
            self.graph.join(last, number, T, UNKNOWN, loop=False)
            same = [k for k, node in self.nodes.items() if node.island == new.island and k != number]
            if not same:
                new.T = self.nodes[last].T @ T
                new.covariance = self.nodes[last].covariance + UNKNOWN
                return
            before = min(same, key=lambda k: view_distance(self.nodes[k].T_odom, new.T_odom, 2.0))
        known = self.nodes[before]
        T = invert(known.T_odom) @ new.T_odom
        covariance = between(known, new.T_odom, new.covariance_odom)
        self.graph.join(before, number, T, covariance, loop=False)
        new.T = se3.orthonormalised(known.T @ T)
        new.covariance = moved_covariance(known.covariance, np.eye(4), T) + covariance

    def _beside(self, number: int, fitter: Fitter, depth: float) -> int:
        """Measures a new node against nodes a little before it, beyond its neighbour; returns how many it could."""
        new, found = self.nodes[number], 0
        assert new.view is not None
        recent = [k for k in self.nodes if k < number and self.nodes[k].island == new.island][-WINDOW:-1]
        ranked = [
            (-distance, k)
            for k in recent
            if self.nodes[k].view is not None
            and (distance := view_distance(self.nodes[k].T_odom, new.T_odom, depth)) < BESIDE
        ]
        for _, k in sorted(ranked)[: self._settings.beside]:
            seen = self._sight(k, number, fitter, Added())
            if seen is not None:
                self.graph.join(k, number, seen.T_known_seen, seen.covariance, loop=True)
                found += 1
        return found

    # -- loops -------------------------------------------------------------------------------------------

    def _look(self, number: int, fitter: Fitter, depth: float, added: Added) -> None:
        """Compares a new node with views that it may see again, and corrects the map by those that it does."""
        new = self.nodes[number]
        loops: list[tuple[int, Sight]] = []
        tried = self._near(number, depth)
        for k in tried:
            seen = self._sight(k, number, fitter, added)
            if seen is not None:
                loops.extend([(k, seen)] if self._expected(k, number, seen) else self._confirmed(k, number, seen))
        if not loops:
            for k in self._alike(number, tried):
                seen = self._sight(k, number, fitter, added)
                if seen is not None:
                    loops.extend([(k, seen)] if self._expected(k, number, seen) else self._confirmed(k, number, seen))
                if loops:
                    break
        if not loops:
            return
        added.loops = len(loops)
        self.loops += len(loops)
        added.found = self._close(number, loops)
        if any(view_distance(np.eye(4), seen.T_known_seen, depth) < SAME for _, seen in loops):
            new.view = None

    def _near(self, number: int, depth: float) -> list[int]:
        """Returns views of long ago that the map expects here, the nearest first."""
        new = self.nodes[number]
        if new.island not in self.tied:
            return []
        ranked = [
            (distance, k)
            for k in self._old(number)
            if (distance := view_distance(self.nodes[k].T, new.T, depth)) < REACH
        ]
        return [k for _, k in sorted(ranked)[: self._settings.near]]

    def _alike(self, number: int, tried: Sequence[int]) -> list[int]:
        """Returns views of long ago that look like the newest, the likest first."""
        view = self.nodes[number].view
        assert view is not None
        likeness = dict(zip(self._index.keys, self._index.likeness(view.words), strict=True))
        ranked = [(-likeness[k], k) for k in self._old(number) if k not in tried and likeness[k] > ALIKE]
        return [k for _, k in sorted(ranked)[: self._settings.alike * (1 if self.located else 2)]]

    def _old(self, number: int) -> list[int]:
        """Returns the nodes of the map with a view, between which and a new one the camera has turned away."""
        new = self.nodes[number]
        return [
            k
            for k, node in self.nodes.items()
            if k != number
            and node.view is not None
            and node.island in self.tied
            and (node.island != new.island or new.travel - node.travel >= self._settings.travel)
        ]

    def _sight(self, k: int, number: int, fitter: Fitter, added: Added) -> Sight | None:
        known, new = self.nodes[k].view, self.nodes[number].view
        assert known is not None
        assert new is not None
        seen = sight(known, new, fitter, self._settings.judge.inliers)
        doubt = "too few features agree" if seen is None else self._settings.judge.doubt(seen)
        if doubt:
            added.refused.append(doubt)
            return None
        return seen

    def _expected(self, k: int, number: int, seen: Sight) -> bool:
        """Tells whether a sight is where the map, with its covariance, has it."""
        known, new = self.nodes[k], self.nodes[number]
        if new.island not in self.tied:
            return False
        off = se3.log(invert(invert(known.T) @ new.T) @ seen.T_known_seen)
        covariance = new.covariance + moved_covariance(known.covariance, known.T, new.T) + seen.covariance + 9 * LEAST
        return bool(off @ np.linalg.solve(covariance, off) < FAR)

    def _confirmed(self, k: int, number: int, seen: Sight) -> list[tuple[int, Sight]]:
        """Notes a surprise; returns it as a loop where another view says the same."""
        known, new = self.nodes[k], self.nodes[number]
        T_map_odom = known.T @ seen.T_known_seen @ invert(new.T_odom)
        agreeing = any(s.agrees(k, number, new, T_map_odom) for s in self.surprises)
        self.surprises = [*self.surprises[-9:], Surprise(number, k, new.island, T_map_odom)]
        return [(k, seen)] if agreeing else []

    def _close(self, number: int, loops: Sequence[tuple[int, Sight]]) -> bool:
        """Adds loops that end at a new node, and corrects the poses; returns whether they tied an island."""
        new = self.nodes[number]
        apart = new.island not in self.tied
        k, seen = loops[0]
        if apart:
            T = self.nodes[k].T @ seen.T_known_seen @ invert(new.T)
            for node in self.nodes.values():
                if node.island == new.island:
                    node.T = se3.orthonormalised(T @ node.T)
            self.tied.add(new.island)
            self.surprises = []
        strained = False
        for k, seen in loops:
            off = se3.log(invert(invert(self.nodes[k].T) @ new.T) @ seen.T_known_seen)
            strained |= bool(off @ np.linalg.solve(seen.covariance + LEAST, off) > STRAIN)
            self.graph.join(k, number, seen.T_known_seen, seen.covariance + LEAST, loop=True)
        self.graph.settle(None if strained else WINDOW)
        for k, seen in loops:
            covariance = moved_covariance(self.nodes[k].covariance, np.eye(4), seen.T_known_seen) + seen.covariance
            if apart or np.trace(covariance) < np.trace(new.covariance):
                new.covariance = covariance
        return apart

    # -- the camera --------------------------------------------------------------------------------------

    def covariance_at(self, T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
        """Returns the covariance (6, 6) in the map of a pose that the odometry says."""
        newest = self.newest
        if newest is None:
            return covariance_odom
        T = invert(newest.T_odom) @ T_odom
        return moved_covariance(newest.covariance, np.eye(4), T) + between(newest, T_odom, covariance_odom)


def between(node: Node, T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
    """Returns the covariance (6, 6) of the motion from a node to a pose of the same odometry.

    It is what the odometry's own covariance has grown by; where that fell, since an older keyframe was found again,
    both count in full.
    """
    carried = moved_covariance(node.covariance_odom, node.T_odom, T_odom)
    grown = covariance_odom - carried
    if np.linalg.eigvalsh(grown)[0] < -1e-9:
        grown = covariance_odom + carried
    return np.asarray(grown + DRIFT, np.float64)
