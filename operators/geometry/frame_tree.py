"""Frames of a robot as a tree: fixed and moving transforms, looked up by stamp.

Each frame has one parent. A moving transform is known at stamps; between two of them it is interpolated on SE(3), at
the constant twist that leads from one to the other. Foote, "tf: the transform library", 2013, has the same shape.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from dataflow.messages import Odometry, Pose, Transforms
from dataflow.messages.geometry import invert
from dataflow.operator import Remembered
from operators.geometry import se3
from operators.geometry.se3 import Matrix

Reason = Literal[
    "loop", "second parent", "repeated", "not finite", "unknown frame", "not connected", "too early", "too late", "gap"
]


class TransformError(ValueError):
    """A transform that cannot be taken in or given; `reason` is its kind in a word or two."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason: Reason = reason


@dataclass(eq=False)
class _Edge:
    """A frame in its parent: one matrix for ever, or one for each stamp, ascending."""

    parent: str
    fixed: Matrix | None = None
    stamps: list[int] = field(default_factory=list)
    matrices: list[Matrix] = field(default_factory=list)


class FrameTree(Remembered):
    """Transforms between named frames, of the last `horizon` nanoseconds.

    Two stamps farther apart than `gap` are not interpolated between; up to `reach` beyond the newest stamp a transform
    goes on with its last twist.
    """

    _edges: dict[str, _Edge]

    def __init__(self, *, horizon: int = 10_000_000_000, gap: int = 1_000_000_000, reach: int = 0) -> None:
        self._horizon, self._gap, self._reach = horizon, gap, reach
        self._edges = {}

    def fix(self, frame: str, child: str, T_frame_child: Matrix) -> None:
        """Takes in a transform that never changes.

        Raises TransformError for a loop, a second parent, or one that is not finite.
        """
        _check_finite(frame, child, T_frame_child)
        self._edge(frame, child).fixed = np.array(T_frame_child, np.float64)

    def add(self, stamp: int, frame: str, child: str, T_frame_child: Matrix) -> None:
        """Takes in a transform at a stamp above the newest one of its frame.

        Raises TransformError for a loop, a second parent, a stamp that is not newer, or one that is not finite.
        """
        _check_finite(frame, child, T_frame_child)
        edge = self._edge(frame, child)
        if edge.stamps and stamp <= edge.stamps[-1]:
            raise TransformError(
                "repeated", f"{child!r} in {frame!r} is known at {edge.stamps[-1]}, and is told again at {stamp}"
            )
        edge.stamps.append(stamp)
        edge.matrices.append(np.array(T_frame_child, np.float64))
        old = bisect_left(edge.stamps, stamp - self._horizon)
        del edge.stamps[:old], edge.matrices[:old]

    def lookup(self, frame: str, child: str, stamp: int) -> Matrix:
        """Returns `T_frame_child` (4, 4) at a stamp.

        Raises TransformError where a frame is unknown, the two are not connected, or a transform between them is not
        known at that stamp: too early, too late, or in a gap.
        """
        ups, downs = self._way(child), self._way(frame)
        shared = next((name for name in ups if name in downs), None)
        if shared is None:
            raise TransformError("not connected", f"{child!r} hangs on {ups[-1]!r}, but {frame!r} on {downs[-1]!r}")
        T_shared_child, T_shared_frame = (
            self._down(way[: way.index(shared)], stamp) for way in (ups, downs)
        )  # fmt: skip
        return np.asarray(invert(T_shared_frame) @ T_shared_child)

    def _edge(self, frame: str, child: str) -> _Edge:
        if child in self._up(frame):
            raise TransformError("loop", f"{child!r} in {frame!r} would close a loop: {frame!r} is in {child!r}")
        edge = self._edges.setdefault(child, _Edge(frame))
        if edge.parent != frame:
            raise TransformError("second parent", f"{child!r} is in {edge.parent!r}, and is told in {frame!r} as well")
        return edge

    def _up(self, frame: str) -> list[str]:
        """The frame and those that it is in, up to the root."""
        way = [frame]
        while way[-1] in self._edges:
            way.append(self._edges[way[-1]].parent)
        return way

    def _way(self, frame: str) -> list[str]:
        if frame not in self._edges and all(edge.parent != frame for edge in self._edges.values()):
            known = sorted({*self._edges, *(edge.parent for edge in self._edges.values())})
            raise TransformError("unknown frame", f"no frame {frame!r}; there are {', '.join(known) or 'none'}")
        return self._up(frame)

    def _down(self, children: Iterable[str], stamp: int) -> Matrix:
        """`T_root_leaf` of frames listed from the leaf on, each in the next."""
        T: Matrix = np.eye(4)
        for child in children:
            T = self._at(child, stamp) @ T
        return T

    def _at(self, child: str, stamp: int) -> Matrix:
        edge = self._edges[child]
        if edge.fixed is not None:
            return edge.fixed
        name, stamps, matrices = f"{child!r} in {edge.parent!r}", edge.stamps, edge.matrices
        i = bisect_left(stamps, stamp)
        if i < len(stamps) and stamps[i] == stamp:
            return matrices[i]
        if i == 0:
            early = (stamps[0] - stamp) * 1e-9
            raise TransformError("too early", f"{name} is known from {stamps[0]} on, {early:.3f} s after {stamp}")
        if i == len(stamps):
            if stamp - stamps[-1] > self._reach or len(stamps) < 2:
                late = (stamp - stamps[-1]) * 1e-9
                raise TransformError("too late", f"{name} is known up to {stamps[-1]}, {late:.3f} s before {stamp}")
            i -= 1
        before, after = stamps[i - 1], stamps[i]
        if after - before > self._gap:
            raise TransformError(
                "gap", f"{name} is not known between {before} and {after}, {(after - before) * 1e-9:.3f} s apart"
            )
        return se3.interpolated(matrices[i - 1], matrices[i], (stamp - before) / (after - before))


def _check_finite(frame: str, child: str, T_frame_child: Matrix) -> None:
    if not np.isfinite(T_frame_child).all():
        raise TransformError("not finite", f"{child!r} in {frame!r} is not finite")


def told_by(message: Transforms | Pose | Odometry) -> list[tuple[str, str, Matrix]]:
    """Returns the transforms (parent, child, T_parent_child) of a message; a pose without child has none."""
    if isinstance(message, Transforms):
        return list(zip(message.frames, message.child_frames, message.matrices(), strict=True))
    return [(message.frame, message.child_frame, message.matrix())] if message.child_frame else []
