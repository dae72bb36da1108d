"""Views of boards without images: corners through a made lens, with noise."""

from __future__ import annotations

import numpy as np
from made_boards import Array, Lens, pose, seen, turned

from operators.calibration.boards import Board, View


def view(board: Board, lens: Lens, T_camera_board: Array, rng: np.random.Generator, stamp: int = 0) -> View:
    """The corners within the image, 0.1 px off."""
    pixels = lens.project(seen(board, T_camera_board))
    inside = ((pixels > 1) & (pixels < [lens.width - 2, lens.height - 2])).all(axis=1)
    ids = np.flatnonzero(inside)
    return View(stamp, ids, pixels[ids] + rng.normal(0, 0.1, (len(ids), 2)), 2.0)


def poses(board: Board, count: int, rng: np.random.Generator, tilt: float = 0.6, deep: float = 2.5) -> list[Array]:
    """Poses all over the image: `tilt` (rad) at most, distances from 0.3 m to `deep` times that."""
    found = []
    for _ in range(count):
        far = 0.3 * rng.uniform(1, deep)
        x, y = rng.uniform(-0.45, 0.45, 2) * far
        found.append(pose(board, turned(*rng.uniform(-tilt, tilt, 2), rng.uniform(-0.3, 0.3)), (x, 0.8 * y, far)))
    return found
