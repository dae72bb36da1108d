"""A map of views whose poses are corrected when a camera comes back to where it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.camera import RgbdCamera
from operators.odometry.keyframe import Keyframe, view_distance
from operators.odometry.local_map import typical_depth
from operators.odometry.settings import RgbdOdometryConfig
from operators.odometry.tracking import moved_covariance
from operators.slam.place_index import PlaceIndex
from operators.slam.pose_graph import Edge, optimised
from operators.slam.visual_view import Judge, Sight, View, sight

UNKNOWN = np.diag([1.0] * 3 + [1.0] * 3)  # covariance (6, 6) of a motion that nothing measured, m² and rad²
LEAST = np.diag([0.002**2] * 3 + [0.001**2] * 3)  # of any measured one: calibration errs alike in all
REACH = 0.7  # radians of view change at which a view may be met again where the map expects it
SAME = 0.12  # radians of view change below which a place needs no second view
ALIKE = 0.05  # likeness from which a view may be one seen before
AGREE = (0.1, 0.05)  # metres and radians by which two sights of one surprise may differ


@dataclass(frozen=True)
class GraphSettings:
    """Angles are of view: rotation plus baseline over depth, radians."""

    spacing: float = 0.2  # between views of the map
    travel: float = 1.5  # along the way between two views that a loop may join
    near: int = 2  # views compared with, of those that the map expects here
    alike: int = 2  # and of those that look alike, wherever they are
    judge: Judge = field(default_factory=Judge)


@dataclass(eq=False)
class Node:
    """A keyframe in the graph: `T_odom` and `T` (4, 4) pose the camera in the odometry frame, as it was said, and in
    the map; `covariance` and `covariance_odom` (6, 6) are theirs. A place that has a view already has no second one.
    """

    stamp: int
    T_odom: Matrix
    covariance_odom: Matrix
    T: Matrix
    covariance: Matrix
    travel: float  # radians of view change on the way here
    island: int  # one number for all that one unbroken chain of odometry joins
    view: View | None


@dataclass(frozen=True, eq=False)
class Surprise:
    """A sight that the map did not expect; it needs a second one that says the same."""

    node: int
    known: int
    T_map_odom: Matrix
    seen: Sight


@dataclass(eq=False)
class Added:
    """What became of a keyframe: loops found from it, and why views that were compared with were refused."""

    node: bool = False
    loops: int = 0
    found: bool = False  # the map, from an island apart
    refused: list[str] = field(default_factory=list)


class VisualGraph:
    """Keyframes, motions between neighbours by odometry, and loops between views of one place.

    A chain of odometry that is broken begins an island. The first is the map, unless a map was loaded; others are tied
    to it by the first loops between them, two of which must agree.
    """

    def __init__(self, settings: GraphSettings, config: RgbdOdometryConfig) -> None:
        self._settings, self._config = settings, config
        self.nodes: list[Node] = []
        self.edges: list[Edge] = []
        self.T_map_odom: Matrix = np.eye(4)
        self.fixed = 1  # nodes that corrections leave where they are
        self.tied: set[int] = {0}  # islands whose place in the map is known
        self.surprises: list[Surprise] = []
        self.segments: dict[int, int] = {}  # the odometry's segments' islands
        self._index = PlaceIndex()

    @property
    def located(self) -> bool:
        """Tells whether the newest keyframe's place in the map is known."""
        here = self.nodes[-1].island if len(self.nodes) > self._loaded else 0
        return here in self.tied

    def take(self, nodes: Sequence[Node], fixed: int) -> None:
        """Begins with nodes that were made before, of which the first `fixed` never move."""
        self.nodes, self.edges, self.fixed = list(nodes), [], fixed
        self._index = PlaceIndex()
        for k, node in enumerate(self.nodes):
            if node.view is not None:
                self._index.add(k, node.view.words)

    def begin_in(self, saved: Sequence[Node]) -> None:
        """Begins with a saved map, in which the camera is to be found; its nodes never move."""
        self.take(saved, len(saved))
        self.tied = {node.island for node in saved}

    # -- growth ------------------------------------------------------------------------------------------

    def add(self, keyframe: Keyframe, camera: RgbdCamera, found_again: bool) -> Added:
        """Takes a keyframe of the odometry, whose working image the camera's K_color is of.

        `found_again` says that the odometry has found its own map again, so that its pose jumped.
        """
        last = self.nodes[-1] if len(self.nodes) > self._loaded else None
        island = self._island(keyframe, last)
        depth = typical_depth(keyframe.surface)
        broken = last is None or island != last.island or found_again
        moved = 0.0
        if last is not None and not broken:
            moved = view_distance(last.T_odom, keyframe.T_world_camera, depth)
            if moved < self._settings.spacing:
                return Added()
        node = Node(
            stamp=keyframe.stamp, T_odom=keyframe.T_world_camera, covariance_odom=keyframe.covariance,
            T=self.T_map_odom @ keyframe.T_world_camera, covariance=keyframe.covariance,
            travel=(last.travel if last else 0.0) + (self._settings.travel if broken else moved),
            island=island, view=View.of(keyframe, camera),
        )  # fmt: skip
        self.nodes.append(node)
        self._chain(last, broken)
        added = Added(node=True)
        self._look(camera, depth, added)
        if node.view is not None:
            self._index.add(len(self.nodes) - 1, node.view.words)
        return added

    @property
    def _loaded(self) -> int:
        return sum(node.island < 0 for node in self.nodes)

    def _island(self, keyframe: Keyframe, last: Node | None) -> int:
        """Returns the island of a keyframe: that of its segment, or a new one for a segment that is new."""
        if last is None:
            self.segments = {keyframe.segment: 0}
        newest = max(self.segments)
        if keyframe.segment > newest:
            self.segments[keyframe.segment] = 1 + max(node.island for node in self.nodes)
        else:  # segments above it were joined to it, or dropped
            self.segments = {s: i for s, i in self.segments.items() if s <= keyframe.segment}
        return self.segments[keyframe.segment]

    def _chain(self, last: Node | None, broken: bool) -> None:
        """Ties the newest node to its island, by odometry."""
        new = self.nodes[-1]
        if last is None:
            return
        before = last
        if broken:
            self._tie(len(self.nodes) - 2, invert(last.T_odom) @ new.T_odom, UNKNOWN)
            same = [node for node in self.nodes[:-1] if node.island == new.island]
            if not same:
                new.T, new.covariance = last.T @ invert(last.T_odom) @ new.T_odom, last.covariance + UNKNOWN
                return
            before = min(same, key=lambda node: view_distance(node.T_odom, new.T_odom, 2.0))
        T = invert(before.T_odom) @ new.T_odom
        covariance = between(before, new.T_odom, new.covariance_odom)
        self._tie(self.nodes.index(before), T, covariance)
        new.T = se3.orthonormalised(before.T @ T)
        new.covariance = moved_covariance(before.covariance, np.eye(4), T) + covariance
        if broken:
            self.T_map_odom = se3.orthonormalised(new.T @ invert(new.T_odom))

    def _tie(self, first: int, T: Matrix, covariance: Matrix) -> None:
        information = np.asarray(np.linalg.inv(covariance), np.float64)
        self.edges.append(Edge(first, len(self.nodes) - 1, T, information, False))

    # -- loops -------------------------------------------------------------------------------------------

    def _look(self, camera: RgbdCamera, depth: float, added: Added) -> None:
        """Compares the newest node with views that it may see again, and corrects the map by those that it does."""
        new = self.nodes[-1]
        assert new.view is not None
        loops: list[tuple[int, Sight]] = []
        tried = self._near(depth)
        for k in tried:
            seen = self._sight(k, camera, added)
            if seen is not None and self._expected(k, seen):
                loops.append((k, seen))
            elif seen is not None:
                loops.extend(self._confirmed(k, seen))
        if not loops:
            for k in self._alike(tried):
                seen = self._sight(k, camera, added)
                if seen is None:
                    continue
                loops.extend([(k, seen)] if self._expected(k, seen) else self._confirmed(k, seen))
                if loops:
                    break
        if not loops:
            return
        if any(view_distance(np.eye(4), seen.T_known_seen, depth) < SAME for _, seen in loops):
            new.view = None
        added.loops = len(loops)
        added.found = self._close(loops)

    def _near(self, depth: float) -> list[int]:
        """Returns views of long ago that the map expects here, the nearest first."""
        new = self.nodes[-1]
        if new.island not in self.tied:
            return []
        ranked = [
            (distance, k) for k in self._old() if (distance := view_distance(self.nodes[k].T, new.T, depth)) < REACH
        ]
        return [k for _, k in sorted(ranked)[: self._settings.near]]

    def _alike(self, tried: Sequence[int]) -> list[int]:
        """Returns views of long ago that look like the newest, the likest first."""
        new = self.nodes[-1]
        assert new.view is not None
        likeness = dict(zip(self._index.keys, self._index.likeness(new.view.words), strict=True))
        ranked = [(-likeness[k], k) for k in self._old() if k not in tried and likeness[k] > ALIKE]
        return [k for _, k in sorted(ranked)[: self._settings.alike]]

    def _old(self) -> list[int]:
        """Returns the nodes of the map with a view, between which and the newest the camera has turned away."""
        new = self.nodes[-1]
        return [
            k
            for k, node in enumerate(self.nodes[:-1])
            if node.view is not None
            and node.island in self.tied
            and (node.island != new.island or new.travel - node.travel >= self._settings.travel)
        ]

    def _sight(self, k: int, camera: RgbdCamera, added: Added) -> Sight | None:
        known, new = self.nodes[k].view, self.nodes[-1].view
        assert known is not None
        assert new is not None
        seen = sight(known, new, camera, self._config, self._settings.judge.inliers)
        doubt = "too few features agree" if seen is None else self._settings.judge.doubt(seen)
        if doubt:
            added.refused.append(doubt)
            return None
        return seen

    def _expected(self, k: int, seen: Sight) -> bool:
        """Tells whether a sight is where the map, with its covariance, has it."""
        known, new = self.nodes[k], self.nodes[-1]
        if new.island not in self.tied:
            return False
        T = invert(known.T) @ new.T
        off = se3.log(invert(T) @ seen.T_known_seen)
        covariance = new.covariance + moved_covariance(known.covariance, known.T, new.T) + seen.covariance + 9 * LEAST
        return bool(off @ np.linalg.solve(covariance, off) < 30.0)  # 6 degrees of freedom

    def _confirmed(self, k: int, seen: Sight) -> list[tuple[int, Sight]]:
        """Notes a surprise; returns it as a loop where another view says the same."""
        known, new = self.nodes[k], self.nodes[-1]
        T_map_odom = known.T @ seen.T_known_seen @ invert(new.T_odom)
        agreeing = [s for s in self.surprises if self._agree(s, k, T_map_odom)]
        self.surprises = [*self.surprises[-9:], Surprise(len(self.nodes) - 1, k, T_map_odom, seen)]
        return [(k, seen)] if agreeing else []

    def _agree(self, other: Surprise, k: int, T_map_odom: Matrix) -> bool:
        new, node = self.nodes[-1], self.nodes[other.node]
        if node.island != new.island:
            return False
        if other.node == len(self.nodes) - 1 and other.known == k:
            return False
        off = se3.log(invert(other.T_map_odom @ new.T_odom) @ T_map_odom @ new.T_odom)
        return bool(np.linalg.norm(off[:3]) < AGREE[0] and np.linalg.norm(off[3:]) < AGREE[1])

    def _close(self, loops: Sequence[tuple[int, Sight]]) -> bool:
        """Adds loops that end at the newest node, and corrects all poses; returns whether they tied an island."""
        new = self.nodes[-1]
        last = len(self.nodes) - 1
        k, seen = loops[0]
        apart = new.island not in self.tied
        if apart:
            self._move_island(self.nodes[k].T @ seen.T_known_seen @ invert(new.T))
            self.surprises = []
        for k, seen in loops:
            information = np.asarray(np.linalg.inv(seen.covariance + LEAST), np.float64)
            self.edges.append(Edge(k, last, seen.T_known_seen, information, True))
        self._optimise()
        for k, seen in loops:
            covariance = moved_covariance(self.nodes[k].covariance, np.eye(4), seen.T_known_seen) + seen.covariance
            if apart or np.trace(covariance) < np.trace(new.covariance):
                new.covariance = covariance
        return apart

    def _move_island(self, T: Matrix) -> None:
        island = self.nodes[-1].island
        for node in self.nodes:
            if node.island == island:
                node.T = se3.orthonormalised(T @ node.T)
        self.tied.add(island)

    def _optimise(self) -> None:
        poses = optimised([node.T for node in self.nodes], self.edges, self.fixed).poses
        for node, T in zip(self.nodes, poses, strict=True):
            node.T = T
        newest = self.nodes[-1]
        self.T_map_odom = se3.orthonormalised(newest.T @ invert(newest.T_odom))

    # -- the camera --------------------------------------------------------------------------------------

    def covariance_at(self, T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
        """Returns the covariance (6, 6) in the map of a pose that the odometry says."""
        if not self.nodes:
            return covariance_odom
        newest = self.nodes[-1]
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
    return np.asarray(grown + LEAST, np.float64)


def positions(nodes: Sequence[Node]) -> NDArray[np.float64]:
    """Returns where nodes are in the map, (N, 3)."""
    return np.array([node.T[:3, 3] for node in nodes]).reshape(-1, 3)
