"""A map of views whose poses are corrected when a sensor comes back to where it was, whatever the sensor is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic

import numpy as np

from dataflow.messages.geometry import invert
from dataflow.operator import Remembered
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.tracking import moved_covariance
from operators.slam.keyframe_graph import KeyframeGraph, Node
from operators.slam.sensor_model import (
    Eyes,
    Index,
    KeyframeResult,
    Moved,
    PlaceSettings,
    Sighting,
    UnexpectedView,
    V,
    alike,
)

UNKNOWN = np.diag([1.0] * 3 + [1.0] * 3)  # covariance (6, 6) of a motion that nothing measured, m² and rad²
WINDOW = 10  # newest keyframes, which are settled at every new one
STRAIN = 12.6  # squared sigmas (95 % of 6 degrees of freedom) by which a loop may be off before the whole map moves
FAR = 30.0  # squared sigmas by which a sight may be off before it is a surprise


class PlaceGraph(Remembered, Generic[V]):
    """Keyframes, motions between neighbours by odometry and by sight, and loops between views of one place.

    A chain of odometry that is broken begins an island. The first is the map, unless a map was loaded; others are tied
    to it by the first loops between them, two of which must agree.
    """

    graph: KeyframeGraph[V]
    T_map_odom: Matrix
    tied: set[int]  # islands whose place in the map is known
    islands: int  # begun so far
    segments: dict[int, int]  # the odometry's segments' islands
    surprises: list[UnexpectedView]
    loops: int

    def __init__(self, settings: PlaceSettings, index: Callable[[], Index[V]], moved: Moved) -> None:
        self._settings, self._new_index, self._moved = settings, index, moved
        self.graph, self.T_map_odom, self.tied = KeyframeGraph(), np.eye(4), {0}
        self.islands, self.segments, self.surprises, self.loops = 0, {}, [], 0
        self._index = index()

    @property
    def nodes(self) -> dict[int, Node[V]]:
        return self.graph.nodes

    @property
    def newest(self) -> Node[V] | None:
        """The newest keyframe that was seen, and not loaded."""
        return self.nodes[self.graph.newest] if self.islands else None

    @property
    def located(self) -> bool:
        """Returns whether the newest keyframe's place in the map is known."""
        newest = self.newest
        return (newest.island if newest else 0) in self.tied

    def begin_in(self, saved: Sequence[Node[V]]) -> None:
        """Begins with a saved map, in which the sensor is to be found; its nodes never move."""
        self.graph.begin_with(saved)
        self.tied = {node.island for node in saved}
        self.restored()

    def restored(self) -> None:
        """Makes the place index of the nodes' views."""
        self._index = self._new_index()
        for k, node in self.nodes.items():
            if node.view is not None:
                self._index.add(k, node.view)

    # -- growth ------------------------------------------------------------------------------------------

    def grow(
        self, stamp: int, T_odom: Matrix, covariance_odom: Matrix, segment: int, jumped: bool,
        eyes: Eyes[V], view: Callable[[], V],
    ) -> KeyframeResult:  # fmt: skip
        """Takes a pose of the odometry, and its view if it becomes a keyframe.

        `segment` is a number for all that one map of the odometry holds; `jumped`: the odometry has found its own map
        again, so that its pose jumped.
        """
        last = self.newest
        island = self._island(segment)
        broken = last is None or island != last.island or jumped
        moved = 0.0
        if last is not None and not broken:
            moved = eyes.distance(last.T_odom, T_odom)
            if moved < self._settings.spacing * (1.0 if self.located else 0.5):
                return KeyframeResult()
        before = self.graph.newest if last is not None else None
        new = Node(
            stamp=stamp, T_odom=T_odom, covariance_odom=covariance_odom, T=self.T_map_odom @ T_odom,
            covariance=covariance_odom,
            travel=(last.travel if last else 0.0) + (self._settings.travel if broken else moved),
            island=island, view=view(),
        )  # fmt: skip
        number, seen = self.graph.add(new), new.view
        if before is not None:
            self._chain(before, number, broken, eyes)
        added = KeyframeResult(node=True)
        self._look(number, eyes, added)
        if not added.loops and self._beside(number, eyes):
            self.graph.settle(WINDOW)
        if seen is not None:
            self._adjust(number, seen, eyes)
        self.T_map_odom = se3.orthonormalised(new.T @ invert(new.T_odom))
        if new.view is not None:
            self._index.add(number, new.view)
        for k in [k for k, node in self.nodes.items() if node.view is None and k <= number - WINDOW]:
            self.graph.retire(k)
        return added

    def withdraw(self, since: int) -> None:
        """Forgets the nodes from a stamp on, and what was tied by them: the odometry took back where they are."""
        gone = {k for k, node in self.nodes.items() if node.stamp >= since and k not in self.graph.fixed}
        self.graph.remove(gone)
        self.graph.settle()
        self.surprises = []
        self.restored()

    def _adjust(self, number: int, view: V, eyes: Eyes[V]) -> None:
        """Improves the newest nodes by what their views share, if the sensor's kind supports it."""

    def _island(self, segment: int) -> int:
        """Returns the island of a segment: its own, or a new one for a segment that is new."""
        if segment not in self.segments or segment > max(self.segments):
            self.segments[segment] = self.islands
            self.islands += 1
        else:  # segments above it were joined to it, or dropped
            self.segments = {s: i for s, i in self.segments.items() if s <= segment}
        return self.segments[segment]

    def _chain(self, last: int, number: int, broken: bool, eyes: Eyes[V]) -> None:
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
            before = min(same, key=lambda k: eyes.distance(self.nodes[k].T_odom, new.T_odom))
        known = self.nodes[before]
        T = invert(known.T_odom) @ new.T_odom
        covariance = self._moved(known, new.T_odom, new.covariance_odom)
        self.graph.join(before, number, T, covariance, loop=False)
        new.T = se3.orthonormalised(known.T @ T)
        new.covariance = moved_covariance(known.covariance, np.eye(4), T) + covariance

    def _beside(self, number: int, eyes: Eyes[V]) -> int:
        """Measures a new node against nodes a little before it, beyond its neighbour; returns how many it could.

        Odometry errs little from there to here, so a sight that contradicts it is of a pattern that repeats.
        """
        new, found = self.nodes[number], 0
        recent = [k for k in self.nodes if k < number and self.nodes[k].island == new.island][-WINDOW:-1]
        ranked = [
            (-distance, k)
            for k in recent
            if self.nodes[k].view is not None
            and (distance := eyes.distance(self.nodes[k].T_odom, new.T_odom)) < self._settings.aside
        ]
        for _, k in sorted(ranked)[: self._settings.beside]:
            seen = eyes.sight(self.nodes, k, number, True)
            if not isinstance(seen, str) and alike(self.nodes[k].T_odom @ seen.T_known_seen, new.T_odom):
                self.graph.join(k, number, seen.T_known_seen, seen.covariance, loop=True)
                found += 1
        return found

    # -- loops -------------------------------------------------------------------------------------------

    def _look(self, number: int, eyes: Eyes[V], added: KeyframeResult) -> None:
        """Compares a new node with views that it may see again, and corrects the map by those that it does."""
        new = self.nodes[number]
        loops: list[tuple[int, Sighting]] = []
        tried = self._near(number, eyes)
        for k in tried:
            loops.extend(self._weighed(number, self._sights(number, [k], eyes, True, added)))
        if not loops:
            loops = self._recognised(number, self._alike(number, tried), eyes, added)
        if not loops:
            return
        added.loops = len(loops)
        self.loops += len(loops)
        added.found = self._close(number, loops)
        if any(eyes.distance(np.eye(4), seen.T_known_seen) < self._settings.same for _, seen in loops):
            new.view = None

    def _recognised(
        self, number: int, candidates: Sequence[int], eyes: Eyes[V], added: KeyframeResult
    ) -> list[tuple[int, Sighting]]:
        """Returns loops to views that look alike, of which the first that is believed will do."""
        for k in candidates:
            loops = self._weighed(number, self._sights(number, [k], eyes, False, added))
            if loops:
                return loops
        return []

    def _near(self, number: int, eyes: Eyes[V]) -> list[int]:
        """Returns views of long ago that the map expects here, the nearest first."""
        new = self.nodes[number]
        if new.island not in self.tied:
            return []
        ranked = [
            (distance, k)
            for k in self._old(number)
            if (distance := eyes.distance(self.nodes[k].T, new.T)) < self._settings.reach
        ]
        return [k for _, k in sorted(ranked)[: self._settings.near]]

    def _alike(self, number: int, tried: Sequence[int]) -> list[int]:
        """Returns views of long ago that look like the newest, the likest first."""
        s = self._settings
        most = s.alike if self.located else s.searched
        view = self.nodes[number].view
        if not most or view is None:
            return []
        likeness = self._index.likeness(view)
        ranked = [(-likeness[k], k) for k in self._old(number) if k not in tried and likeness[k] > s.likeness]
        return [k for _, k in sorted(ranked)[:most]]

    def _old(self, number: int) -> list[int]:
        """Returns the nodes of the map with a view, between which and a new one the sensor has turned away."""
        new = self.nodes[number]
        return [
            k
            for k, node in self.nodes.items()
            if k != number
            and node.view is not None
            and node.island in self.tied
            and (node.island != new.island or new.travel - node.travel >= self._settings.travel)
        ]

    def _sights(
        self, number: int, candidates: Sequence[int], eyes: Eyes[V], expected: bool, added: KeyframeResult
    ) -> list[tuple[int, Sighting]]:
        """Returns those of the candidates that are seen again; notes why the others are not."""
        found: list[tuple[int, Sighting]] = []
        for k in candidates:
            seen = eyes.sight(self.nodes, k, number, expected)
            if isinstance(seen, str):
                added.refused.append(seen)
            else:
                found.append((k, seen))
        return found

    def _weighed(self, number: int, sights: Sequence[tuple[int, Sighting]]) -> list[tuple[int, Sighting]]:
        """Returns the sights that are loops: those that the map expects, and surprises that were seen twice."""
        return [
            (k, seen)
            for k, seen in sights
            if self._expected(k, number, seen) or self._confirmed(k, number, seen)
        ]  # fmt: skip

    def _expected(self, k: int, number: int, seen: Sighting) -> bool:
        """Returns whether a sight is where the map, with its covariance, has it."""
        known, new = self.nodes[k], self.nodes[number]
        if new.island not in self.tied:
            return False
        off = se3.log(invert(invert(known.T) @ new.T) @ seen.T_known_seen)
        covariance = (
            new.covariance + moved_covariance(known.covariance, known.T, new.T) + seen.covariance
            + 9 * self._settings.least
        )  # fmt: skip
        return bool(off @ np.linalg.solve(covariance, off) < FAR)

    def _confirmed(self, k: int, number: int, seen: Sighting) -> bool:
        """Stores a surprise; returns whether another view agrees with it."""
        known, new = self.nodes[k], self.nodes[number]
        T_map_odom = known.T @ seen.T_known_seen @ invert(new.T_odom)
        agreeing = any(s.agrees(k, number, new, T_map_odom) for s in self.surprises)
        self.surprises = [*self.surprises[-9:], UnexpectedView(number, k, new.island, T_map_odom)]
        return agreeing

    def _close(self, number: int, loops: Sequence[tuple[int, Sighting]]) -> bool:
        """Adds loops that end at a new node, and corrects the poses; returns whether they tied an island."""
        new, least = self.nodes[number], self._settings.least
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
            strained |= bool(off @ np.linalg.solve(seen.covariance + least, off) > STRAIN)
            self.graph.join(k, number, seen.T_known_seen, seen.covariance + least, loop=True)
        self.graph.settle(None if strained else WINDOW)
        for k, seen in loops:
            covariance = moved_covariance(self.nodes[k].covariance, np.eye(4), seen.T_known_seen) + seen.covariance
            if apart or np.trace(covariance) < np.trace(new.covariance):
                new.covariance = covariance
        return apart

    # -- the sensor --------------------------------------------------------------------------------------

    def covariance_at(self, T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
        """Returns the covariance (6, 6) in the map of a pose of the odometry."""
        newest = self.newest
        if newest is None:
            return covariance_odom
        T = invert(newest.T_odom) @ T_odom
        return moved_covariance(newest.covariance, np.eye(4), T) + self._moved(newest, T_odom, covariance_odom)
