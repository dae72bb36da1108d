"""The heading of a room: the direction, up to quarter turns, along which most of what stands in it lies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ANGLES = np.radians(np.arange(0.0, 90.0, 2.0))
_BIN = 0.05  # metres
_POINTS = 3000  # of a view
_BELOW = 0.3  # metres above the lowest points, where floors end
_SHARP = 1.15  # of the mean sharpness, from which there is such a direction


class RoomHeading:
    """Accumulates over views how sharp the outline of a room is along each direction.

    Seen from above, walls and furniture that lie along a direction fall on few lines across it: the sum of squares of
    the points' histogram along both axes is greatest for the room's own. After the entropy of projections in Olufs and
    Vincze, "Robust room-structure estimation in Manhattan-like environments", 2011.
    """

    def __init__(self) -> None:
        self.scores: Array = np.zeros(len(_ANGLES))
        self.views = 0

    def add(self, points: Array) -> None:
        """Takes the points (N, 3) of one view, z up."""
        if len(points) < 100:
            return
        standing = points[points[:, 2] > np.percentile(points[:, 2], 2) + _BELOW]
        flat = standing[:: 1 + len(standing) // _POINTS, :2]
        if len(flat) < 100:
            return
        flat = flat - flat.mean(axis=0)
        for k, angle in enumerate(_ANGLES.tolist()):
            c, s = np.cos(angle), np.sin(angle)
            for axis in ((c, s), (-s, c)):
                cells = np.floor(flat @ axis / _BIN).astype(np.int64)
                counts = np.bincount(cells - cells.min())
                self.scores[k] += float((counts * counts).sum()) / len(flat) ** 2
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
