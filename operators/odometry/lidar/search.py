"""Searches where a scan was taken: poses around a guess, by how well it lies on the planes of a map there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.lidar.fit import agreements
from operators.odometry.lidar.map import PlaneMap

Array = NDArray[np.float64]

STEP, WIDE_STEP = 0.5, 1.0  # metres between poses, and those of a search that reaches far
WIDE = 4.0  # metres from which a search reaches far
ANY_TURN = np.asarray(np.arange(24) * (np.pi / 12), np.float64)  # headings, where none is known
_SEARCHED = 120  # points that are looked at
_WIDTH = 6.0  # standard deviations of the kernel
_WORTH = 0.7  # share of the best pose's score from which another is worth a look
_APART = (0.9, 0.4)  # metres and radians between two places


def around(
    points: Array, planes: PlaneMap, T: Matrix, reach: float, turns: Array, noise: float
) -> tuple[Array, Array]:  # fmt: skip
    """Returns the poses (K, 4, 4) up to `reach` metres to each side of a guess, turned by `turns` (N,), best first.

    With them come their scores (K,): points (of about 120) that lie on planes, a little less far from the guess.
    """
    step = STEP if reach < WIDE else WIDE_STEP
    steps = np.arange(-int(reach / step), int(reach / step) + 1) * step
    x, y, turn = (grid.ravel() for grid in np.meshgrid(steps, steps, turns, indexing="ij"))
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(turn)
    poses[:, 1, 0] = np.sin(turn)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    poses = T @ poses
    chosen = points[:: max(1, len(points) // _SEARCHED)]
    scores = agreements(chosen, planes, poses, noise, _WIDTH) - 1e-3 * (np.abs(x) + np.abs(y))
    best = np.argsort(-scores, kind="stable")
    return poses[best], scores[best]


def places(poses: Array, scores: Array, most: int) -> list[Matrix]:
    """Returns the best of poses (K, 4, 4) that have scores (K,), best first, no two of them of one place."""
    found: list[Matrix] = []
    for T in poses[scores > _WORTH * scores[0]]:
        if all(apart(T, other) for other in found):
            found.append(T)
        if len(found) == most:
            break
    return found


def apart(A: Matrix, B: Matrix) -> bool:
    """Returns whether two poses are of two places."""
    off = se3.log(invert(A) @ B)
    return bool(np.linalg.norm(off[:3]) > _APART[0] or np.linalg.norm(off[3:]) > _APART[1])
