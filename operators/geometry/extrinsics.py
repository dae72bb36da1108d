"""Extrinsics: the transform between the frames of two sensors of one robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Transforms
from dataflow.messages.geometry import invert, matrix_to_quaternion
from operators.geometry.frame_tree import FrameTree, TransformError, told_by
from operators.geometry.se3 import Matrix

Array = NDArray[np.float64]


def transform_between(extrinsics: Transforms | None, source: str, target: str) -> Matrix:
    """Returns `T_target_source` (4, 4): the identity where the frames are one or no extrinsics are given.

    Raises ValueError where the extrinsics do not relate the two frames, in either direction or over others, or by a
    transform that is not finite.
    """
    if extrinsics is None or source == target:
        return np.eye(4)
    return _between(extrinsics, source, target).copy()


@lru_cache(maxsize=64)  # extrinsics are seldom others than at the last firing; messages are equal by digest
def _between(extrinsics: Transforms, source: str, target: str) -> Matrix:
    T_target_source = _found(extrinsics, source, target)
    if not np.isfinite(T_target_source).all():
        raise ValueError(f"extrinsics hold a transform between {source!r} and {target!r} that is not finite")
    return T_target_source


def _found(extrinsics: Transforms, source: str, target: str) -> Matrix:
    known = list(zip(extrinsics.frames, extrinsics.child_frames, strict=True))
    if (target, source) in known:
        return np.asarray(extrinsics.matrices()[known.index((target, source))])
    if (source, target) in known:
        return invert(extrinsics.matrices()[known.index((source, target))])
    tree = FrameTree()
    for told in told_by(extrinsics):
        tree.fix(*told)
    listed = ", ".join(f"{child} in {parent}" for parent, child in known) or "none"
    try:
        return tree.lookup(target, source, 0)
    except TransformError:
        raise ValueError(
            f"extrinsics hold no transform between {source!r} and {target!r}; they hold {listed}"
        ) from None


def with_transform(
    extrinsics: Transforms | None, stamp: int, frame: str, child_frame: str, T_frame_child: Matrix
) -> Transforms:
    """Returns the extrinsics, as the tree that they are, with `child_frame` at `T_frame_child` (4, 4) in `frame`.

    Only the child is placed anew, with all that hangs below it. Where it is above `frame`, that one is placed instead;
    where `frame` is new, all that the child belongs to is placed in it. Raises ValueError where the extrinsics hold
    both frames and do not relate them.
    """
    rows: dict[str, tuple[str, Array, Array]] = {}
    if extrinsics is not None:
        placed = zip(extrinsics.frames, extrinsics.translations, extrinsics.rotations, strict=True)
        rows = dict(zip(extrinsics.child_frames, placed, strict=True))
    above = list(_above(rows, child_frame))
    if child_frame in _above(rows, frame):
        frame, child_frame, T_frame_child = child_frame, frame, invert(T_frame_child)
    if child_frame in rows:
        known = frame in rows or any(parent == frame for parent, _, _ in rows.values())
        other = rows[child_frame][0] if known else above[-1]
        if known:
            frame, T_frame_child = other, transform_between(extrinsics, frame, other) @ T_frame_child
        else:
            T_frame_child = T_frame_child @ transform_between(extrinsics, other, child_frame)
            child_frame = other
    rows[child_frame] = (frame, T_frame_child[:3, 3], matrix_to_quaternion(T_frame_child))
    return Transforms(
        stamp=stamp,
        frames=tuple(parent for parent, _, _ in rows.values()),
        child_frames=tuple(rows),
        translations=np.array([position for _, position, _ in rows.values()]),
        rotations=np.array([quaternion for _, _, quaternion in rows.values()]),
    )


def _above(rows: Mapping[str, tuple[str, Array, Array]], frame: str) -> Iterator[str]:
    """Yields the parent of a frame, that one's parent, and so on."""
    for _ in range(len(rows)):
        if frame not in rows:
            return
        frame = rows[frame][0]
        yield frame
