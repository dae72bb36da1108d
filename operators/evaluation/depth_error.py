"""Errors of a depth image against the true one. Images are (H, W), metres, 0 or NaN for no return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class DepthErrors:
    """Figures of one image, over the pixels that both have; NaN where there is none.

    Eigen et al., "Depth map prediction from a single image using a multi-scale deep network", 2014.
    """

    judged: int  # pixels whose true depth is known
    measured: int  # of them, with a depth
    rmse: float  # metres
    relative: float  # mean of |error| / true depth
    middle: float  # median of the same
    near: float  # share with max(found / true, true / found) < 1.25


def depth_errors(found: Depth, true: Depth) -> DepthErrors:
    """Compares two images of one size and one view. Raises ValueError for two sizes."""
    if found.shape != true.shape:
        raise ValueError(f"depth has {found.shape} pixels, but the truth {true.shape}")
    known = np.isfinite(true) & (true > 0)
    both = known & np.isfinite(found) & (found > 0)
    judged, measured = int(known.sum()), int(both.sum())
    if not measured:
        return DepthErrors(judged, 0, np.nan, np.nan, np.nan, np.nan)
    z, truth = found[both].astype(np.float64), true[both].astype(np.float64)
    error, ratio = np.abs(z - truth), np.maximum(z / truth, truth / z)
    return DepthErrors(
        judged,
        measured,
        rmse=float(np.sqrt(np.mean(error**2))),
        relative=float(np.mean(error / truth)),
        middle=float(np.median(error / truth)),
        near=float(np.mean(ratio < 1.25)),
    )
