"""Truth of a view, cell by cell, as the focus network should tell it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.focus.cells import STRIDE
from operators.detection.focus.views import NONE

UNKNOWN, NOTHING = -2, -1
"""Classes of cells of which nothing is to be said, and of cells that show none of the things."""
_LEAST = 6  # cells of a thing that is to be found


def targets(
    owners: NDArray[np.uint8], classes: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Returns of each cell (S/2, S/2) the class, the sides (4, S/2, S/2) of its thing, and how much it counts.

    Sides are those of what is seen of the thing, x1, y1, x2, y2 in the view's pixels. The cells of a large thing count
    less each. Things of too few cells are unknown.
    """
    cells = owners[1::STRIDE, 1::STRIDE]
    labels, weights = np.full(cells.shape, NOTHING, np.int64), np.zeros(cells.shape, np.float32)
    sides = np.zeros((4, *cells.shape), np.float32)
    for k, of in enumerate(classes[classes != NONE].tolist()):
        own = cells == k + 1
        count = int(own.sum())
        if not count:
            continue
        x, y, width, height = cv2.boundingRect((owners == k + 1).astype(np.uint8))
        labels[own] = of if count >= _LEAST else UNKNOWN
        weights[own] = count**-0.5
        sides[:, own] = np.array([[x], [y], [x + width], [y + height]], np.float32)
    return labels, sides, weights
