"""The tree of coordinate frames as a viewer must draw it: complete from the first message on, whatever arrives first.

Streams name frames long before (or without ever) saying where they lie. This tree accepts poses in any order, decides
which of several streams that place the same frame wins, and hangs what nothing places under the root, so that
everything can be drawn. What it assumes it marks, so that the viewer can say so. Pure: no viewer, no clock.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from dataflow.messages.geometry import invert

Matrix = npt.NDArray[np.float64]

ROOTS = ("earth", "map", "world", "odom")
"""Names that make a frame the root of the picture, best first (REP 105)."""

_HISTORY = 64
"""Poses of each stream kept for aligning two of them at equal stamps."""


class FrameCycleError(ValueError):
    """A frame placed within itself, at once or by a chain of poses that were all given."""


class FramePriority(IntEnum):
    """Whose word counts when several streams place the same frame: the lowest."""

    TREE = 0
    ESTIMATE = 1
    TRUTH = 2
    UNSHOWN = 3


@dataclass(frozen=True, slots=True)
class Attach:
    """`child` now lies at `T_parent_child` in `parent`. `assumed`: no stream places it, it is only drawn there."""

    child: str
    parent: str
    T_parent_child: Matrix
    assumed: bool


@dataclass(frozen=True, slots=True)
class Detach:
    """`child` is a root again."""

    child: str


@dataclass(frozen=True, slots=True)
class NewRoot:
    """The frame that everything is drawn in."""

    frame: str


Change = Attach | Detach | NewRoot


@dataclass(slots=True)
class _Edge:
    parent: str
    T_parent_child: Matrix
    owner: str  # "" where no stream places it
    rank: FramePriority | None  # None: assumed

    @property
    def assumed(self) -> bool:
        return self.rank is None


@dataclass(slots=True)
class _Sighting:
    """The recent poses that one stream gave for one frame."""

    parent: str
    poses: deque[tuple[int, Matrix]] = field(default_factory=lambda: deque(maxlen=_HISTORY))


class FrameTree:
    """Tree of frames. Every method returns the changes to draw, in order; none: nothing changed."""

    def __init__(self) -> None:
        self.root: str | None = None
        self._edges: dict[str, _Edge] = {}
        self._frames: dict[str, None] = {}
        self._sightings: dict[tuple[str, str], _Sighting] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._frames

    def see(self, frame: str) -> list[Change]:
        """A message names `frame`."""
        if frame in self._frames:
            return []
        self._frames[frame] = None
        return self._join_roots()

    def place(
        self, parent: str, child: str, T_parent_child: Matrix, *, owner: str, rank: FramePriority, stamp: int
    ) -> list[Change]:
        """Places `child`, by stream `owner`, at `T_parent_child` (4×4) in `parent`.

        When another stream of the same or better rank places `child` already, the pose only serves to align the two
        streams' root frames, once. Raises `FrameCycleError`.
        """
        if parent == child:
            raise FrameCycleError(f"{owner} places the frame {child!r} in itself")
        sighting = self._sightings.setdefault((child, owner), _Sighting(parent))
        if sighting.parent != parent:
            sighting = self._sightings[child, owner] = _Sighting(parent)
        sighting.poses.append((stamp, T_parent_child))
        self._frames.setdefault(parent)
        self._frames.setdefault(child)

        held = self._edges.get(child)
        rival = held.owner if held is not None and held.rank is not None and held.owner != owner else None
        changes: list[Change] = []
        if held is None or held.rank is None or rival is None or rank < held.rank:
            changes += self._break_cycle(parent, child, owner)
            self._edges[child] = _Edge(parent, T_parent_child, owner, rank)
            changes.append(Attach(child, parent, T_parent_child, assumed=False))
        if rival is not None:
            changes += self._align(child, rival, owner)
        return changes + self._join_roots()

    def owner(self, frame: str) -> str | None:
        """Returns the stream that places `frame`; None where none does."""
        edge = self._edges.get(frame)
        return None if edge is None or edge.assumed else edge.owner

    def pose(self, frame: str) -> Matrix | None:
        """`T_root_frame` (4×4), or None for a frame that is unknown."""
        if frame not in self._frames:
            return None
        return self._to_top(frame)[1]

    def pose_at(self, frame: str, stamp: int) -> Matrix | None:
        """`T_root_frame` (4×4) at a stamp (ns).

        None where a frame on the way moves and no stream places it then, or is only assumed to lie somewhere.
        """
        if frame not in self._frames:
            return None
        T = np.eye(4)
        while (edge := self._edges.get(frame)) is not None:
            if edge.assumed and not edge.owner:
                return None
            poses = self._sightings[frame, edge.owner].poses if not edge.assumed else ()
            then = next((pose for at, pose in reversed(poses) if at == stamp), None)
            if then is None and (edge.rank not in (FramePriority.TREE, None) or len(poses) > 1):
                return None
            T = (edge.T_parent_child if then is None else then) @ T
            frame = edge.parent
        return T

    def assumed(self) -> dict[str, str]:
        """Frame → parent, for the frames that no stream places."""
        return {child: edge.parent for child, edge in self._edges.items() if edge.assumed}

    def reason(self, frame: str) -> str:
        """Returns which streams an assumed place was worked out from; empty where it is the parent's origin."""
        edge = self._edges.get(frame)
        return edge.owner if edge is not None and edge.assumed else ""

    def _to_top(self, frame: str) -> tuple[str, Matrix]:
        T = np.eye(4)
        while (edge := self._edges.get(frame)) is not None:
            T = edge.T_parent_child @ T
            frame = edge.parent
        return frame, T

    def _path(self, frame: str) -> list[str]:
        path = [frame]
        while (edge := self._edges.get(frame)) is not None:
            frame = edge.parent
            path.append(frame)
        return path

    def _break_cycle(self, parent: str, child: str, owner: str) -> list[Change]:
        """Makes room for child-in-parent where parent hangs below child: an assumed link on the way gives in."""
        path = self._path(parent)
        if child not in path:
            return []
        below = path[: path.index(child)]
        weak = next((frame for frame in below if self._edges[frame].assumed), None)
        if weak is None:
            raise FrameCycleError(
                f"{owner} places {child!r} in {parent!r}, but {parent!r} already hangs below it: "
                + " in ".join(map(repr, path[: path.index(child) + 1]))
            )
        del self._edges[weak]
        return [Detach(weak)]

    def _align(self, child: str, first: str, second: str) -> list[Change]:
        """Hangs the root of the second stream's parent where both streams put `child` in the same place."""
        a, b = self._sightings.get((child, first)), self._sightings.get((child, second))
        if a is None or b is None:
            return []
        changes: list[Change] = []
        if self._to_top(a.parent)[0] == self._to_top(b.parent)[0]:
            links = [frame for frame in self._path(a.parent) + self._path(b.parent) if self._is_blind(frame)]
            if not links:
                return []
            del self._edges[links[0]]
            changes.append(Detach(links[0]))
        top_a, T_topa_a = self._to_top(a.parent)
        top_b, T_topb_b = self._to_top(b.parent)
        if top_a == top_b:
            return changes
        _, T_a, T_b = min(
            ((abs(sa - sb), Ta, Tb) for sa, Ta in a.poses for sb, Tb in b.poses), key=lambda candidate: candidate[0]
        )
        T_a_b = T_topa_a @ T_a @ invert(T_topb_b @ T_b)
        if _preference(top_a) <= _preference(top_b):
            lower, upper, T = top_b, top_a, T_a_b
        else:
            lower, upper, T = top_a, top_b, invert(T_a_b)
        self._edges[lower] = _Edge(upper, T, f"{first} and {second}", None)
        return [*changes, Attach(lower, upper, T, assumed=True)]

    def _is_blind(self, frame: str) -> bool:
        """Returns whether `frame` hangs where it does only because it had to hang somewhere."""
        edge = self._edges.get(frame)
        return edge is not None and edge.assumed and not edge.owner

    def _join_roots(self) -> list[Change]:
        roots = [frame for frame in self._frames if frame not in self._edges]
        best = min(roots, key=lambda frame: (_preference(frame), frame != self.root))
        changes: list[Change] = []
        for frame in roots:
            if frame != best:
                self._edges[frame] = _Edge(best, np.eye(4), "", None)
                changes.append(Attach(frame, best, np.eye(4), assumed=True))
        if best != self.root:
            self.root = best
            changes.append(NewRoot(best))
        return changes


def _preference(frame: str) -> int:
    """Returns how much a frame is the one to draw everything in: 0 is best. Prefixes (`robot1/map`) do not count."""
    name = frame.rsplit("/", 1)[-1]
    return ROOTS.index(name) if name in ROOTS else len(ROOTS)
