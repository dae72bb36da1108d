"""A map of LiDAR scans whose poses are corrected when the LiDAR comes back to where it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.lidar.search import apart
from operators.odometry.tracking import moved_covariance
from operators.slam.keyframe_graph import SAVED, KeyframeGraph, Node
from operators.slam.lidar.scan_context import likeness
from operators.slam.lidar.view import LidarEyes, LidarSight, LidarView
from operators.slam.place_graph import PlaceGraph
from operators.slam.sensor_model import Eyes, KeyframeResult, PlaceSettings, Sighting, alike

DRIFT = np.diag([0.004**2] * 3 + [0.0015**2] * 3)  # errors of odometry beyond its covariance, over a metre
STEP = np.diag([0.002**2] * 3 + [0.001**2] * 3)  # and at each keyframe
ASIDE, RIVALS = 2.5, 12  # metres from a place, and views beyond these that are looked at before it is believed
RIVAL = 0.1  # by which the score of another place may be less than that of the best where it explains a scan as well
BETWEEN = 1.0  # metres between these
LOOKS = 2  # views that a scan is compared with at each call while the map is searched for
AMBIGUOUS = "ambiguous: another place explains the scan as well"
LEAST = np.diag([0.002**2] * 3 + [0.001**2] * 3)  # of a sight: noise and calibration err alike in all


@dataclass(frozen=True)
class LidarSettings(PlaceSettings):
    """Settings of a map of scans. A change of view is in metres, a radian of turn counting half a metre.

    Only where the place in the map is not known are scans compared that look alike: odometry of a LiDAR drifts so
    little that a place seen again lies where the map expects it.
    """

    spacing: float = 0.5
    travel: float = 4.0
    reach: float = 1.0
    same: float = 0.25
    aside: float = 0.0
    beside: int = 0
    near: int = 2
    alike: int = 0
    searched: int = 3
    likeness: float = 0.5
    least: Matrix = field(default_factory=LEAST.copy)


@dataclass(eq=False)
class Search:
    """A scan that is looked for in the map: views that it is yet to be compared with, and those that it saw again.

    Once these give a place, what is left are the `rivals`: views elsewhere that may explain the scan as well.
    """

    number: int
    candidates: list[int]
    sights: list[tuple[int, LidarSight]] = field(default_factory=list)
    rivals: list[int] = field(default_factory=list)


class _Contexts:
    """The place index of scans."""

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._views: list[LidarView] = []

    def add(self, key: int, view: LidarView) -> None:
        self._keys.append(key)
        self._views.append(view)

    def likeness(self, view: LidarView) -> dict[int, float]:
        alike, _ = likeness(view.context, np.array([known.context for known in self._views]))
        return dict(zip(self._keys, alike.tolist(), strict=True))


class LidarGraph(PlaceGraph[LidarView]):
    """The map that a LiDAR makes."""

    graph: KeyframeGraph[LidarView]
    search: Search | None  # of a scan in the map, while the place is not known
    place: Search | None  # the scan that a place was found for, of which rivals are looked at
    again: Search | None  # a later scan that found that place too

    def __init__(self, settings: LidarSettings, eyes: LidarEyes) -> None:
        super().__init__(settings, _Contexts, between)
        self._eyes = eyes
        self.search = self.place = self.again = None

    def add(
        self, stamp: int, T_odom: Matrix, covariance: Matrix, view: LidarView, segment: int, found_again: bool
    ) -> KeyframeResult:
        """Takes a scan and its pose in the odometry frame.

        `segment` is the number of the odometry's map; `found_again`: it found this map again after a loss.
        """
        added = self.grow(stamp, T_odom, covariance, segment, found_again, self._eyes, lambda: view)
        self._continue(added)
        newest = self.newest
        if added.node and newest is not None:
            newest.covariance = self._lesser(newest.covariance, newest.covariance_odom)
        return added

    def covariance_at(self, T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
        """Returns the covariance (6, 6) in the map of a pose of the odometry."""
        return self._lesser(super().covariance_at(T_odom, covariance_odom), covariance_odom)

    def _lesser(self, covariance: Matrix, covariance_odom: Matrix) -> Matrix:
        """Returns the covariance of a pose in the map, which is no greater than the odometry's where both frames began.

        Along the chain of keyframes it grows with every step, while the odometry's own map may be more precise.
        """
        newest = self.newest
        began_here = newest is not None and newest.island == 0 and SAVED not in self.tied
        return covariance_odom if began_here and np.trace(covariance_odom) < np.trace(covariance) else covariance

    def _recognised(
        self, number: int, candidates: Sequence[int], eyes: Eyes[LidarView], added: KeyframeResult
    ) -> list[tuple[int, Sighting]]:
        """Begins to look for a scan in views that look alike, unless another is looked for: see `_continue`."""
        if self.search is None and self.again is None and candidates:
            self.search = Search(number, list(candidates))
        return []

    def _continue(self, added: KeyframeResult) -> None:
        """Goes on with the search, by a bounded number of views: each look takes a good part of a second.

        Rivals of a place are looked at while the sensor is on its way to the scan that confirms it.
        """
        searches = [one for one in (self.search, self.place, self.again) if one is not None]
        if self.newest is None or any(self.nodes[one.number].island != self.newest.island for one in searches):
            self.search = self.place = self.again = None  # the odometry began anew
        for _ in range(LOOKS):
            if self.search is not None:
                self._compare(self.search, added)
            elif self.place is not None and self.place.rivals and self._fits(self.place, self.place.rivals.pop(0)):
                added.refused.append(AMBIGUOUS)
                self.place = self.again = None
            if self.again is not None and self.place is not None and not self.place.rivals:
                self._take(self.again, added)

    def _compare(self, search: Search, added: KeyframeResult) -> None:
        """Compares a scan with one more view; after the last, decides whether they give a place."""
        seen = self._sights(search.number, [search.candidates.pop(0)], self._eyes, False, added)
        search.sights += [(k, sight) for k, sight in seen if isinstance(sight, LidarSight)]
        if search.candidates:
            return
        self.search = None
        if not search.sights:
            return
        poses = [self.nodes[k].T @ seen.T_known_seen for k, seen in search.sights]
        if not all(alike(poses[0], T) for T in poses[1:]):
            added.refused.append(AMBIGUOUS)
            return
        confirmed = bool(self._weighed(search.number, search.sights[:1]))
        if not (confirmed and self._same_place(search)):
            search.rivals = self._rivals(search)
            self.place = search
        self.again = search if confirmed else None

    def _same_place(self, search: Search) -> bool:
        """Returns whether a scan was found where the place is whose rivals are looked at, by the odometry."""
        if self.place is None or self.nodes[self.place.number].island != self.nodes[search.number].island:
            return False
        (known, best), (other, seen) = self.place.sights[0], search.sights[0]
        way = invert(self.nodes[self.place.number].T_odom) @ self.nodes[search.number].T_odom
        return alike(self.nodes[known].T @ best.T_known_seen @ way, self.nodes[other].T @ seen.T_known_seen)

    def _take(self, search: Search, added: KeyframeResult) -> None:
        """Closes the loop to the view that looks most alike: all that are believed say the same, and none elsewhere."""
        self.search = self.place = self.again = None
        loops = search.sights[:1]
        added.loops += len(loops)
        self.loops += len(loops)
        added.found = self._close(search.number, loops)
        newest = self.newest
        assert newest is not None
        self.T_map_odom = se3.orthonormalised(newest.T @ invert(newest.T_odom))

    def _rivals(self, search: Search) -> list[int]:
        """Returns views elsewhere, by which a scan may have been taken as well: those that look most like it.

        Those that look most alike of all may be at one of two places that are alike. A look reaches beyond its view, so
        of views beside each other one is enough.
        """
        view, (known, best) = self.nodes[search.number].view, search.sights[0]
        assert view is not None
        T = self.nodes[known].T @ best.T_known_seen
        likeness = self._index.likeness(view)
        chosen = list[int]()
        for k in sorted(self._old(search.number), key=lambda k: -likeness[k]):
            place = self.nodes[k].T[:3, 3]
            near = any(np.linalg.norm(place - self.nodes[other].T[:3, 3]) < BETWEEN for other in chosen)
            if np.linalg.norm(place - T[:3, 3]) > ASIDE and not near:
                chosen.append(k)
        return chosen[:RIVALS]

    def _fits(self, search: Search, k: int) -> bool:
        """Returns whether a view elsewhere explains a scan as well as the place where it was found."""
        known, best = search.sights[0]
        seen = self._eyes.sight(self.nodes, k, search.number, False)
        return (
            isinstance(seen, LidarSight)
            and isinstance(best, LidarSight)
            and seen.registered.score > best.registered.score - RIVAL
            and apart(self.nodes[known].T @ best.T_known_seen, self.nodes[k].T @ seen.T_known_seen)
        )


def between(node: Node[LidarView], T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
    """Returns the covariance (6, 6) of the motion from a node to a pose of the same odometry.

    It is what the odometry's own covariance has changed by: where that fell, since the LiDAR came back into a part of
    its map that is more certain, the pose was corrected by as much.
    """
    change = covariance_odom - moved_covariance(node.covariance_odom, node.T_odom, T_odom)
    values, axes = np.linalg.eigh((change + change.T) / 2)
    way = float(np.linalg.norm((invert(node.T_odom) @ T_odom)[:3, 3]))
    return np.asarray((axes * np.abs(values)) @ axes.T + way * DRIFT + STEP, np.float64)
