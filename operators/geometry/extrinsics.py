"""Extrinsics: the transform between the frames of two sensors of one robot."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dataflow.messages import Transforms
from dataflow.messages.geometry import invert
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
