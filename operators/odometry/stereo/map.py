"""The pairs that a stereo odometry keeps to find its place again."""

from __future__ import annotations

from dataclasses import dataclass, replace

from operators.geometry.se3 import Matrix, orthonormalised
from operators.odometry.keyframes import redundant, view_distance
from operators.odometry.stereo.relocalizer import TYPICAL, StereoKeyframe

RECENT = 5  # newest keyframes, never forgotten


@dataclass(frozen=True, eq=False)
class StereoMap:
    """Keyframes in order of time, those of the segment that the camera is in last, and what is known of their place.

    After a loss a new segment begins: keyframes whose place among the older ones is unknown until one of those is
    recognised.
    """

    keyframes: tuple[StereoKeyframe, ...] = ()
    unit: float = 1.0  # metres: of the scene that the map began with, things are typically `TYPICAL` of them away
    recalls: int = 0  # frames that the map was searched for since the last loss
    apart_since: int | None = None  # stamp at which the newest segment began, while its place is unknown

    @property
    def segment(self) -> int:
        """The number of the newest segment."""
        return self.keyframes[-1].segment if self.keyframes else 0

    @property
    def unused_segment(self) -> int:
        """The number of a segment that no keyframe is of."""
        return 1 + max((k.segment for k in self.keyframes), default=-1)

    @property
    def elsewhere(self) -> list[StereoKeyframe]:
        """The keyframes of older segments."""
        return [k for k in self.keyframes if k.segment != self.segment]

    def due(self, T_world_camera: Matrix, distance: float) -> bool:
        """Returns whether a view differs from the newest keyframe's by an angle in radians, or that of the baseline."""
        newest = self.keyframes[-1] if self.keyframes else None
        return newest is None or view_distance(newest.T_world_camera, T_world_camera, TYPICAL * self.unit) > distance

    def with_keyframe(self, keyframe: StereoKeyframe, capacity: int) -> StereoMap:
        """Adds a keyframe, and forgets the old one that its neighbours make up for."""
        kept = [*self.keyframes, keyframe]
        if len(kept) > capacity:
            del kept[redundant([k.T_world_camera for k in kept], RECENT, TYPICAL * self.unit)]
        return replace(self, keyframes=tuple(kept))

    def begun_anew(self, stamp: int) -> StereoMap:
        """Marks the next keyframe's place among the others as unknown since a stamp."""
        return replace(self, apart_since=stamp, recalls=0)

    def placed(self, known: StereoKeyframe, T_known_newest: Matrix | None) -> StereoMap:
        """Moves the newest segment rigidly as given by one of its motions into a keyframe's world; without such a
        motion, forgets it."""
        if known.segment == self.segment:
            return replace(self, recalls=0)
        kept = [k if k.segment != self.segment else _moved(k, known, T_known_newest) for k in self.keyframes]
        left = sorted((k for k in kept if k is not None), key=lambda k: k.segment == known.segment)
        return replace(self, keyframes=tuple(left), apart_since=None, recalls=0)


def _moved(keyframe: StereoKeyframe, known: StereoKeyframe, T_known_newest: Matrix | None) -> StereoKeyframe | None:
    if T_known_newest is None:
        return None
    T = orthonormalised(T_known_newest @ keyframe.T_world_camera)
    return replace(keyframe, T_world_camera=T, covariance=known.covariance, segment=known.segment)
