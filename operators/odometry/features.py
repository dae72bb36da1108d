"""Sparse features: spread corners, their Lucas-Kanade tracks, and ORB matches where tracking cannot reach."""

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Pixels = NDArray[np.float64]
Mask = NDArray[np.bool_]

LK_WINDOW = (15, 15)
LK_LEVELS = 3
LK_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02)


def detect_corners(gray: Gray, count: int) -> Pixels:
    """At most count corners (N, 2), spread over the image. Shi and Tomasi, "Good features to track", 1994."""
    spacing = max(3.0, 0.6 * float(np.sqrt(gray.size / count)))
    corners = cv2.goodFeaturesToTrack(gray, count, qualityLevel=0.005, minDistance=spacing, blockSize=5)
    return np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)


def track_corners(gray_from: Gray, gray_to: Gray, pixels_from: Pixels, guess_to: Pixels) -> tuple[Pixels, Mask]:
    """Follow pixels (N, 2) from one image into another, starting at a guess. Bouguet, 2000."""
    if len(pixels_from) == 0:
        return np.zeros((0, 2)), np.zeros(0, bool)
    height, width = gray_to.shape
    inside = (guess_to > -20).all(axis=1) & (guess_to[:, 0] < width + 20) & (guess_to[:, 1] < height + 20)
    start = np.where(inside[:, None], guess_to, pixels_from).astype(np.float32)
    ends, found, _ = cv2.calcOpticalFlowPyrLK(
        gray_from, gray_to, pixels_from.astype(np.float32), start, winSize=LK_WINDOW, maxLevel=LK_LEVELS,
        criteria=LK_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
    )  # fmt: skip
    moved = np.asarray(ends, np.float64)
    seen = (moved >= 0).all(axis=1) & (moved[:, 0] < width) & (moved[:, 1] < height)
    return moved, np.asarray((found.ravel() > 0) & seen & inside, np.bool_)


def with_exposure_of(reference: Gray, gray: Gray) -> Gray:
    """gray with the mean and contrast of a reference view: Lucas-Kanade assumes that brightness stays."""
    mean, spread = (float(x[0, 0]) for x in cv2.meanStdDev(gray))
    mean_wanted, spread_wanted = (float(x[0, 0]) for x in cv2.meanStdDev(reference))
    gain = min(max(spread_wanted / max(spread, 1.0), 0.4), 2.5)
    if abs(gain - 1.0) < 0.03 and abs(mean_wanted - mean) < 2.0:
        return gray
    table = np.clip(np.rint((np.arange(256) - mean) * gain + mean_wanted), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(gray, table), np.uint8)


class OrbMatcher:
    """Descriptors and mutual nearest matches. Rublee et al., "ORB", 2011."""

    def __init__(self, count: int = 1000) -> None:
        self._orb = cv2.ORB.create(count, scaleFactor=1.2, nlevels=8, edgeThreshold=15, patchSize=31, fastThreshold=7)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)

    def describe(self, gray: Gray) -> tuple[Pixels, NDArray[np.uint8]]:
        """Pixels (N, 2) and their descriptors (N, 32)."""
        points, descriptors = self._orb.detectAndCompute(gray, None)
        if descriptors is None:
            return np.zeros((0, 2)), np.zeros((0, 32), np.uint8)
        return np.array([p.pt for p in points], np.float64), np.asarray(descriptors, np.uint8)

    def match(self, descriptors_a: NDArray[np.uint8], descriptors_b: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Pairs of indices (M, 2) that are each other's nearest and near."""
        if len(descriptors_a) == 0 or len(descriptors_b) == 0:
            return np.zeros((0, 2), np.int64)
        matches = self._matcher.match(descriptors_a, descriptors_b)
        return np.array([(m.queryIdx, m.trainIdx) for m in matches if m.distance < 64], np.int64).reshape(-1, 2)
