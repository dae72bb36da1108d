"""A LiDAR scan as the odometry takes it: usable points, thinned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.odometry.lidar.map import thinned

Array = NDArray[np.float64]

SPACINGS = 40  # median range of a scan over the spacing of the points that are kept of it
_CLOSEST, _WIDEST = 0.05, 0.5  # metres
MOST = 4000  # points that a pose is fitted to
SPARSER = 4  # the points that a pose is fitted to are so many times farther apart than those that go into the map


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (N, 3) in the sensor's frame, metres, and when each was measured after the stamp (N,), seconds.

    `sample` (M,) are indices of those that a pose is fitted to. `unusable` counts points that were not finite, or out
    of range. `offsets` is None where all points belong to the stamp.
    """

    points: Array
    offsets: Array | None
    sample: NDArray[np.intp]
    unusable: int

    @property
    def count(self) -> int:
        """Number of points of the sample."""
        return len(self.sample)


def prepare(
    points: NDArray[np.float32], offsets: NDArray[np.float32] | None, near: float, far: float, spacing: float | None
) -> tuple[Scan, float]:
    """Returns the points between `near` and `far` thinned to a spacing, and the spacing.

    None takes a spacing that fits the scan's ranges: a fortieth of their median.
    """
    square = np.einsum("ij,ij->i", points, points)  # NaN where a coordinate is, so such a point is not within
    within = (square >= near * near) & (square <= far * far)
    if offsets is not None:
        within &= np.isfinite(offsets)
    kept = np.flatnonzero(within)
    if spacing is None:
        median = float(np.sqrt(np.median(square[kept]))) if len(kept) else 0.0
        spacing = float(np.clip(median / SPACINGS, _CLOSEST, _WIDEST))
    chosen = kept[thinned(points.take(kept, axis=0), spacing)]
    usable = points.take(chosen, axis=0).astype(np.float64)
    times = None if offsets is None else offsets[chosen].astype(np.float64)
    sample = thinned(usable, SPARSER * spacing)
    sample = sample[:: -(-len(sample) // MOST)] if len(sample) else sample
    return Scan(usable, times, sample, len(points) - len(kept)), spacing
