"""The heading of a room: the direction, up to quarter turns, along which most of what stands in it lies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ANGLES = np.radians(np.arange(0.0, 90.0, 2.0))
_BIN = 0.05  # metres
_LAYER, _LAYERS = 0.1, 4  # metres of height, and in how many such layers what is upright shows, of a place
_FEWEST = 20  # places
_SHARP = 1.15  # of the mean sharpness, from which there is such a direction


class RoomHeading:
    """Accumulates over views how sharp the outline of a room is along each direction.

    Seen from above, walls and fronts of furniture that lie along a direction fall on few lines across it: the sum of
    squares of their histogram along both axes is greatest for the room's own. Only places count where something is
    upright: a table's top, which may stand askew in the middle of a room and is in view all the time, is level. After
    the entropy of projections in Olufs and Vincze, "Robust room-structure estimation in Manhattan-like environments",
    2011.
    """

    def __init__(self) -> None:
        self.scores: Array = np.zeros(len(_ANGLES))
        self.views = 0

    def add(self, points: Array) -> None:
        """Takes the points (N, 3) of one view, z up."""
        flat, weights = _upright(points)
        if len(flat) < _FEWEST:
            return
        whole = float(weights.sum()) ** 2
        for k, angle in enumerate(_ANGLES.tolist()):
            c, s = np.cos(angle), np.sin(angle)
            for axis in ((c, s), (-s, c)):
                cells = np.floor(flat @ axis / _BIN).astype(np.int64)
                counts = np.bincount(cells - cells.min(), weights)
                self.scores[k] += float((counts * counts).sum()) / whole
        self.views += 1

    @property
    def angle(self) -> float | None:
        """Heading in [0, pi / 2); None where no direction stands out."""
        best = int(np.argmax(self.scores))
        if not self.views or self.scores[best] < _SHARP * float(self.scores.mean()):
            return None
        count = len(_ANGLES)
        before, here, after = (float(self.scores[k % count]) for k in (best - 1, best, best + 1))
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
        return float(np.remainder(_ANGLES[best] + shift * (_ANGLES[1] - _ANGLES[0]), np.pi / 2))


def _upright(points: Array) -> tuple[Array, Array]:
    """Returns the places (N, 2), m, where points stand above each other, and in how many layers each does (N,)."""
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0)
    cells = np.floor(points / (_BIN, _BIN, _LAYER)).astype(np.int64)
    x, y, z = (cells - cells.min(axis=0)).T
    high = int(z.max()) + 1
    voxels, of = np.unique((x * (int(y.max()) + 1) + y) * high + z, return_inverse=True)
    _, own, layers = np.unique(voxels // high, return_inverse=True, return_counts=True)
    of = own[of]
    sums = np.column_stack([np.bincount(of, points[:, 0]), np.bincount(of, points[:, 1])])
    kept = layers >= _LAYERS  # where they are on the mean, as corners of cells lie along the axes
    return sums[kept] / np.bincount(of)[kept, None], layers[kept].astype(np.float64)
