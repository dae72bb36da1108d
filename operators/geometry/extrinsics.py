"""Extrinsics: the transform between the frames of two sensors of one robot."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dataflow.messages import Transforms
from dataflow.messages.geometry import invert, matrix_to_quaternion
from operators.geometry.frame_tree import FrameTree, TransformError, told_by
from operators.geometry.se3 import Matrix


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
    """Returns the extrinsics with one transform, in the place of that between the same two frames if they hold it."""
    pairs = [] if extrinsics is None else list(zip(extrinsics.frames, extrinsics.child_frames, strict=True))
    kept = [k for k, pair in enumerate(pairs) if set(pair) != {frame, child_frame}]
    places, turns = [T_frame_child[:3, 3]], [matrix_to_quaternion(T_frame_child)]
    if extrinsics is not None:
        places, turns = [*extrinsics.translations[kept], *places], [*extrinsics.rotations[kept], *turns]
    return Transforms(
        stamp=stamp,
        frames=(*(pairs[k][0] for k in kept), frame),
        child_frames=(*(pairs[k][1] for k in kept), child_frame),
        translations=np.array(places),
        rotations=np.array(turns),
    )
