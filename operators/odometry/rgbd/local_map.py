"""The keyframes that an odometry remembers."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from dataflow.operator import Remembered
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix, orthonormalised
from operators.odometry.keyframes import redundant, view_distance
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.surface import Surface
from operators.odometry.rgbd.trial import Trial, taken_back

RECENT = 5  # newest keyframes, never forgotten
EARLIER = 6  # keyframes back, at most, to one that reveals motion since
REACH = 0.7  # radians of view change beyond which two views share too little to be compared
DRIFTED = 0.06  # metres: no view is laid on the surfaces of keyframes that the odometry may have drifted farther from


def drifted(a: Keyframe, b: Keyframe) -> bool:
    """Returns whether the odometry may have drifted far from one keyframe to the other: see DRIFTED."""
    return abs(a.place_variance - b.place_variance) >= DRIFTED**2


class LocalMap(Remembered):
    """Keyframes in order of time, those of the segment that the camera is in last; those that others make up for are
    forgotten first.

    After a loss a new segment begins: keyframes whose place among the older ones is unknown until one of those is
    recognised. Only keyframes of the newest segment are compared with directly.
    """

    keyframes: list[Keyframe]

    def __init__(self, capacity: int) -> None:
        self.capacity, self.keyframes = capacity, []

    @property
    def newest(self) -> Keyframe:
        return self.keyframes[-1]

    @property
    def elsewhere(self) -> list[Keyframe]:
        """The keyframes of older segments."""
        return [k for k in self.keyframes if k.segment != self.newest.segment]

    def of_segment(self, segment: int) -> list[Keyframe]:
        """Returns the keyframes of a segment."""
        return [k for k in self.keyframes if k.segment == segment]

    @property
    def unused_segment(self) -> int:
        """The number of a segment that no keyframe is of."""
        return 1 + max((k.segment for k in self.keyframes), default=-1)

    def add(self, keyframe: Keyframe) -> None:
        """Remembers a keyframe. Older ones keep their grids alone: the planes that frames are compared with take five
        times their memory, and are made anew of those few keyframes that are near again."""
        self.keyframes.append(keyframe)
        if len(self.keyframes) > self.capacity:
            del self.keyframes[redundant([k.T_world_camera for k in self.keyframes], RECENT)]
        for older in self.keyframes[:-RECENT]:
            older.surface.let_go()

    def drop_newest_segment(self, known: Keyframe) -> None:
        """Forgets a segment that never found its place, for a camera that is in another one."""
        self.keyframes = sorted(self.elsewhere, key=lambda k: k.segment == known.segment)

    def join(self, known: Keyframe, T_known_newest: Matrix) -> None:
        """Moves the newest segment rigidly as given by one of its motions in an older segment's world."""
        segment = self.newest.segment
        self.keyframes = [
            replace(
                k,
                T_world_camera=orthonormalised(T_known_newest @ k.T_world_camera),
                covariance=known.covariance,
                sunk=known.sunk,
                segment=known.segment,
            )
            if k.segment == segment
            else k
            for k in self.keyframes
        ]

    def part(self, trials: Sequence[Trial], fresh: int) -> None:
        """Makes a segment, of a number that is unused, of the newest keyframes, those that rest on places, and takes
        these back."""
        segment, since = self.newest.segment, min(trial.since for trial in trials)
        self.keyframes = [
            replace(k, T_world_camera=orthonormalised(T), covariance=covariance, sunk=np.zeros(6), segment=fresh)
            if k.segment == segment and k.stamp >= since
            else k
            for k in self.keyframes
            for T, covariance in [taken_back(trials, k.stamp, k.T_world_camera, k.covariance)]
        ]

    def nearby(self, T_world_camera: Matrix, count: int, segment: int, reach: float = REACH) -> list[Keyframe]:
        """Returns a segment's newest keyframe, then those whose views are nearest to a pose's, and their places sure.

        A camera that comes round again sees old keyframes at a place that is as far off as it has drifted: laid on
        them, a pose would be torn from one place to the other, and what stands still would seem to move.
        """
        *older, newest = (k for k in self.keyframes if k.segment == segment)
        older = [k for k in older if not drifted(k, newest)]
        depth = newest.surface.typical_depth
        distances = [view_distance(k.T_world_camera, T_world_camera, depth) for k in older]
        ranked = sorted(range(len(older)), key=distances.__getitem__)
        return [newest, *(older[i] for i in ranked[: count - 1] if distances[i] < reach)]

    def references(self, T_world_camera: Matrix, count: int, segment: int) -> list[Keyframe]:
        """Returns keyframes of a segment with a surface, the newest such first, then the nearest views."""
        return [k for k in self.nearby(T_world_camera, count + 2, segment) if k.surface.coverage > 0.02][:count]

    def earlier(self, T_world_camera: Matrix, segment: int) -> list[Keyframe]:
        """Returns the keyframe of a while ago that still shares a pose's view, if there is one."""
        *old, newest = [k for k in self.keyframes if k.segment == segment][-EARLIER:]
        near = (k for k in old[:-1] if view_distance(k.T_world_camera, T_world_camera, 2.0) < 0.5 * REACH)
        return [k for k in near if not drifted(k, newest)][:1]

    def rendered(self, T_world_camera: Matrix, like: Surface) -> Surface:
        """Returns what the map expects a depth camera at a pose to see, on the grid of a surface."""
        h, w = like.inverse_depth.shape
        seen = np.zeros(h * w, np.float32)
        for keyframe in self.references(T_world_camera, 4, self.newest.segment):
            points = keyframe.surface.points()
            T = keyframe.T_camera_world @ T_world_camera
            points = (points - T[:3, 3]) @ T[:3, :3]
            points = points[points[:, 2] > 0.05]
            u, v = np.rint(project(points, like.K)).astype(np.int64).T
            inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
            np.maximum.at(seen, v[inside] * w + u[inside], (1.0 / points[inside, 2]).astype(np.float32))
        inverse = seen.reshape(h, w)
        return Surface(np.where(inverse > 0, inverse, cv2.dilate(inverse, np.ones((3, 3), np.uint8))), like.K)
