"""Sparse features: spread corners and their Lucas-Kanade tracks."""

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Pixels = NDArray[np.float64]
Pixels32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

LK_WINDOW = (15, 15)
LK_LEVELS = 3
LK_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02)


def detect_corners(gray: Gray, count: int, taken: Pixels | None = None) -> Pixels:
    """Finds corners (N, 2), spread over the image and apart from those taken, at most count with them.

    Shi and Tomasi, "Good features to track", 1994.
    """
    spacing = max(3.0, 0.6 * float(np.sqrt(gray.size / count)))
    mask = None
    if taken is not None and len(taken):
        count -= len(taken)
        if count <= 0:
            return np.zeros((0, 2))
        mask = np.full(gray.shape, 255, np.uint8)
        for x, y in np.rint(taken).astype(int).tolist():
            cv2.circle(mask, (x, y), int(spacing), 0, -1)
    corners = cv2.goodFeaturesToTrack(gray, count, 0.005, spacing, mask=mask, blockSize=5)
    return np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)


def track_corners(
    gray_from: Gray, gray_to: Gray, pixels_from: Pixels, guess_to: Pixels, levels: int = LK_LEVELS
) -> tuple[Pixels, Mask]:
    """Follow pixels (N, 2) from one image into another, starting at a guess. Bouguet, 2000.

    Without `levels` of smaller images they are looked for within the window around the guess alone.
    """
    if len(pixels_from) == 0:
        return np.zeros((0, 2)), np.zeros(0, bool)
    height, width = gray_to.shape
    inside = (guess_to > -20).all(axis=1) & (guess_to[:, 0] < width + 20) & (guess_to[:, 1] < height + 20)
    start = np.where(inside[:, None], guess_to, pixels_from).astype(np.float32)
    ends, found = _lucas_kanade(gray_from, gray_to, pixels_from.astype(np.float32), start, levels)
    moved = ends.astype(np.float64)
    seen = (moved >= 0).all(axis=1) & (moved[:, 0] < width) & (moved[:, 1] < height)
    return moved, np.asarray(found & seen & inside, np.bool_)


def with_exposure_of(reference: Gray, gray: Gray) -> Gray:
    """gray with the mean and contrast of a reference view: Lucas-Kanade assumes that brightness stays."""
    mean, spread = (float(x[0, 0]) for x in cv2.meanStdDev(gray))
    mean_wanted, spread_wanted = (float(x[0, 0]) for x in cv2.meanStdDev(reference))
    gain = min(max(spread_wanted / max(spread, 1.0), 0.4), 2.5)
    if abs(gain - 1.0) < 0.03 and abs(mean_wanted - mean) < 2.0:
        return gray
    table = np.clip(np.rint((np.arange(256) - mean) * gain + mean_wanted), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(gray, table), np.uint8)


def track_both_ways(a: Gray, b: Gray, pixels: Pixels, guess: Pixels, back: float) -> tuple[Pixels, Mask]:
    """Follows pixels (N, 2) from image a to b and back again; those that return within `back` pixels are found."""
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, np.bool_)
    height, width = b.shape
    start = np.asarray(pixels, np.float32)
    inside = (guess > -10).all(axis=1) & (guess[:, 0] < width + 10) & (guess[:, 1] < height + 10)
    ends, found = _lucas_kanade(a, b, start, np.where(inside[:, None], guess, pixels).astype(np.float32))
    again, found_back = _lucas_kanade(b, a, ends, start)
    good = found & found_back & (np.abs(again - start).max(axis=1) < back)
    good &= (ends >= 0).all(axis=1) & (ends[:, 0] < width) & (ends[:, 1] < height)
    return ends.astype(np.float64), np.asarray(good, np.bool_)


def _lucas_kanade(
    a: Gray, b: Gray, pixels: Pixels32, guess: Pixels32, levels: int = LK_LEVELS
) -> tuple[Pixels32, Mask]:
    ends, found, _ = cv2.calcOpticalFlowPyrLK(
        a, b, pixels, guess.copy(), winSize=LK_WINDOW, maxLevel=levels,
        criteria=LK_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
    )  # fmt: skip
    return np.asarray(ends, np.float32), np.asarray(found.ravel() > 0, np.bool_)
