"""Keyframes by their poses: those to keep, and those to compare a lost view with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry.se3 import Matrix

TYPICAL_DEPTH = 2.0  # metres
RECALL_NEAR, RECALL_OTHERS = 3, 5  # keyframes, near the prediction and elsewhere, that a lost view is compared with
RECALL_EVERY = 3  # frames, while a new map is tracked for longer than
RECALL_ALWAYS_S = 1.0  # seconds, for which every frame is tried


def view_distance(T_a: Matrix, T_b: Matrix, depth: float) -> float:
    """Returns how differently two cameras see a scene at a depth: baseline / depth + angle between them, radians."""
    T = invert(T_a) @ T_b
    way, trace = T[:3, 3].copy(), float(T[0, 0]) + float(T[1, 1]) + float(T[2, 2])
    cosine = min(max((trace - 1.0) / 2.0, -1.0), 1.0)
    return float(math.sqrt(way.dot(way)) / depth + np.arccos(cosine))


def redundant(poses: Sequence[Matrix], recent: int, depth: float = 2.0) -> int:
    """Returns the index of the old pose, before the `recent` newest, whose neighbours in time see most nearly what it
    sees of a scene at a depth; the first is the last to be one."""
    old = poses[: max(len(poses) - recent, 1)]
    gaps = [view_distance(poses[i - 1], poses[i + 1], depth) for i in range(1, len(old))]
    return 1 + int(np.argmin(gaps)) if gaps else 0


def recall_due(stamp: int, apart_since: int | None, recalls: int) -> bool:
    """Returns whether a new map that is tracked, begun at a stamp and searched for so often, is searched for now."""
    return apart_since is not None and (stamp - apart_since < RECALL_ALWAYS_S * 1e9 or recalls % RECALL_EVERY == 0)


class Posed(Protocol):
    """Stands for anything with a pose."""

    @property
    def T_world_camera(self) -> Matrix: ...


K = TypeVar("K", bound=Posed)


def candidates(
    keyframes: Sequence[K], T_predicted: Matrix, near: int, others: int, turn: int, depth: float = TYPICAL_DEPTH
) -> list[K]:
    """Returns those nearest to a predicted view of a scene at a depth and, in turns, others: all in a few frames."""
    ranked = sorted(keyframes, key=lambda k: view_distance(k.T_world_camera, T_predicted, depth))
    rest = ranked[near:]
    take = min(others, len(rest))
    return [*ranked[:near], *(rest[(turn * take + i) % len(rest)] for i in range(take))]
