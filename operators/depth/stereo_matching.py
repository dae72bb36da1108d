"""Dense disparities of a rectified stereo pair: semi-global matching, in both directions.

Hirschmüller, "Stereo processing by semiglobal matching and mutual information", 2008, as OpenCV has it (costs of
Birchfield and Tomasi).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Disparities = NDArray[np.float32]

_UNITS = 16  # of OpenCV's disparities in a pixel
_PULL = 2.0  # of whole pixels on a parabola's minimum; measured on simulated pairs with known depth
_CORNERS, _FEWEST, _APART = 200, 20, 8.0  # that show how rows correspond: most, fewest, pixels between two


@dataclass(frozen=True)
class MatchingConfig:
    """Settings; penalties are for one pixel of the block, on grey values after OpenCV's prefilter."""

    disparities: int = 128  # pixels, a multiple of 16: things nearer than focal length * baseline / this are not seen
    block: int = 5  # pixels, odd
    small_step: int = 8  # penalty of a disparity that changes by 1 pixel
    large_step: int = 32  # penalty of one that changes by more
    uniqueness: int = 5  # percent by which the best cost must win
    speckle: int = 100  # pixels: smaller patches of one disparity are removed; 0 removes none
    tolerance: float = 1.0  # pixels that the two directions may differ by

    def __post_init__(self) -> None:
        if self.disparities < 16 or self.disparities % 16:
            raise ValueError(f"disparities must be a positive multiple of 16, got {self.disparities}")
        if self.block % 2 == 0:
            raise ValueError(f"block must be odd, got {self.block}")
        if self.small_step > self.large_step:
            raise ValueError(f"small_step {self.small_step} must not exceed large_step {self.large_step}")


@dataclass(frozen=True, eq=False)
class Matched:
    """Disparities of the left image, pixels, NaN where there is none, and how many pixels lost theirs to what."""

    disparity: Disparities
    unmatched: int
    inconsistent: int


class StereoMatcher:
    """Matches left to right and right to left; what agrees is kept, as the mean of the two.

    Each is a parabola's minimum in steps of 1/16 pixel, which whole pixels attract; it is put back (`unlocked`). The
    mean of the two directions is finer than either. The images are continued to the left by the largest disparity, so
    that the left image has disparities up to its edge as far as the right one sees them.
    """

    def __init__(self, config: MatchingConfig | None = None) -> None:
        self._config = c = config or MatchingConfig()
        self._matcher: Any = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=c.disparities,
            blockSize=c.block,
            P1=c.small_step * c.block**2,
            P2=c.large_step * c.block**2,
            disp12MaxDiff=-1,
            preFilterCap=31,
            uniquenessRatio=c.uniqueness,
            speckleWindowSize=c.speckle,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def match(self, left: Gray, right: Gray) -> Matched:
        """Matches two images (H, W) of one size, rows of which correspond."""
        if left.ndim != 2 or left.shape != right.shape:
            raise ValueError(f"left and right must be grey images of one size, got {left.shape} and {right.shape}")
        there = self._one_way(left, right)
        back = self._one_way(right[:, ::-1], left[:, ::-1])[:, ::-1]
        other = sampled(back, there)
        known = np.isfinite(there)
        agreed = known & (np.abs(other - there) <= self._config.tolerance)  # false where other is NaN
        disparity = np.where(agreed, (there + other) / 2, np.nan).astype(np.float32)
        return Matched(disparity, int((~known).sum()), int((known & ~agreed).sum()))

    def _one_way(self, reference: Gray, other: Gray) -> Disparities:
        """Disparities of the reference image, whose points lie farther left in the other."""
        margin = self._config.disparities
        wide = [cv2.copyMakeBorder(image, 0, 0, margin, 0, cv2.BORDER_REPLICATE) for image in (reference, other)]
        found = self._matcher.compute(*wide)[:, margin:].astype(np.float32) / _UNITS
        return unlocked(np.where(found > 0, found, np.nan).astype(np.float32))


def row_offset(left: Gray, right: Gray, disparity: Disparities) -> float:
    """Returns by how many pixels the right image shows things lower than the left one, 0 in a rectified pair.

    It is the median over corners of the left image (H, W) with a disparity, followed by Lucas and Kanade's method from
    where that puts them; 0 where there are fewer than 20.
    """
    known = np.isfinite(disparity)
    corners = cv2.goodFeaturesToTrack(left, _CORNERS, 0.01, _APART, mask=known.astype(np.uint8))
    if corners is None:
        return 0.0
    start = corners[:, 0]
    x, y = start.astype(np.int64).T
    guess = start - np.column_stack([disparity[y, x], np.zeros(len(start), np.float32)])
    ends, found, _ = cv2.calcOpticalFlowPyrLK(
        left, right, start, guess.astype(np.float32), winSize=(15, 15), maxLevel=1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    off = (ends - start)[found.ravel() > 0, 1]
    return float(np.median(off)) if len(off) >= _FEWEST else 0.0


def unlocked(disparity: Disparities) -> Disparities:
    """Returns disparities whose fractions were drawn to whole pixels, spread evenly again.

    A parabola through costs that grow linearly has its minimum too near to the whole pixel, and penalties of steps make
    that worse. Shimizu and Okutomi, "Sub-pixel estimation error cancellation on area-based matching", 2005; Gehrig and
    Franke, "Improving stereo sub-pixel accuracy for long range stereo", 2007.
    """
    whole = np.rint(disparity)
    off = disparity - whole
    away = np.abs(off)
    spread = (1 + _PULL) * away / (1 + 2 * _PULL * away)
    return np.asarray(whole + np.copysign(spread, off), np.float32)


def sampled(back: Disparities, there: Disparities) -> Disparities:
    """Returns the right image's disparity where each left pixel went; NaN outside, and where neither has one.

    Between two right pixels of one surface it is interpolated; at an edge it is the nearer pixel's.
    """
    width = there.shape[1]
    x = np.arange(width, dtype=np.float32)[None] - there
    inside = (x >= 0) & (x <= width - 1)  # false where there is no disparity
    x = np.where(inside, x, 0)
    first = np.minimum(x.astype(np.int64), max(width - 2, 0))
    last = np.minimum(first + 1, width - 1)
    a, b = np.take_along_axis(back, first, 1), np.take_along_axis(back, last, 1)
    share = x - first
    one_surface = np.abs(a - b) < 1
    value = np.where(one_surface, (1 - share) * a + share * b, np.where(share < 0.5, a, b))
    return np.where(inside, value, np.nan).astype(np.float32)
