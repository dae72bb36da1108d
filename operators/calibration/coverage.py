"""Parts of the image in which a board was seen, as figures, words and a picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.calibration.boards import View
from operators.geometry.pinhole import Pixels

UNSEEN = 0.5
"""Share of a part of the image without a board from which it is named."""
ROWS, COLUMNS = ("top", "", "bottom"), ("left", "", "right")
ARROW = 50
"""Times by which residuals are drawn longer."""


def counts(views: Sequence[View], size: tuple[int, int]) -> NDArray[np.int32]:
    """Returns the number of views (H, W) whose corners surround each pixel of images of `size` (width, height)."""
    found = np.zeros(size[::-1], np.int32)
    for view in views:
        inside = np.zeros(size[::-1], np.uint8)
        cv2.fillConvexPoly(inside, cv2.convexHull(view.pixels.astype(np.float32)).astype(np.int32), 1)
        found += inside
    return found


def unseen_parts(seen: NDArray[np.int32]) -> list[str]:
    """Returns the names of the ninths of the image more than half of which no board was in."""
    rows, columns = (np.linspace(0, length, 4).astype(int) for length in seen.shape)
    return [
        f"{ROWS[r]} {COLUMNS[c]}".strip() or "centre"
        for r in range(3)
        for c in range(3)
        if (seen[rows[r] : rows[r + 1], columns[c] : columns[c + 1]] == 0).mean() > UNSEEN
    ]


def in_words(seen: NDArray[np.int32]) -> str:
    """Returns the share of the image that boards were in, and the parts that lack them."""
    lacking = unseen_parts(seen)
    share = f"boards were in {100 * float((seen > 0).mean()):.0f} % of the image"
    return f"{share}; hardly any {', '.join(lacking)}" if lacking else share


def picture(seen: NDArray[np.int32], corners: Pixels, residuals: Pixels) -> NDArray[np.uint8]:
    """Returns an image (H, W, 3), BGR: brighter green where more boards were, red hatching where none, and a white line
    of 50 times the residual (N, 2) at each corner (N, 2)."""
    height, width = seen.shape
    drawn = np.zeros((height, width, 3), np.uint8)
    drawn[..., 1] = np.where(seen > 0, 60 + 150 * np.minimum(seen, 10) / 10, 0)
    step = max(width // 40, 6)
    y, x = np.mgrid[:height, :width]
    drawn[(seen == 0) & ((x + y) % step < max(step // 5, 1))] = (40, 40, 200)
    for (u, v), (du, dv) in zip(corners, residuals, strict=True):
        begin, end = (int(u * 16), int(v * 16)), (int((u + ARROW * du) * 16), int((v + ARROW * dv) * 16))
        cv2.line(drawn, begin, end, (255, 255, 255), 1, cv2.LINE_AA, shift=4)
    return drawn
