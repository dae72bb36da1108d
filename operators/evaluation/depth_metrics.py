"""Scores depth images against ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import DepthImage
from dataflow.operator import Batch, Duration, In, Operator, Param
from operators.evaluation.figures import Figures
from operators.evaluation.pairing import Pairing

Depth = NDArray[np.float32]


class DepthMetrics(Figures, Operator):
    """Collects depth images and the true ones, pixel for pixel, and computes errors when the depths end.

    Images are paired each with the truth nearest in time within `tolerance`; images without a partner are counted and
    not scored. Figures are means over the images that have a depth to judge, with the worst image's RMSE beside them;
    `measured` is the share of the pixels with a known true depth that have one. Both must be of one view: the frames'
    names may differ, as those of two cameras at one place do.

    Method: Eigen et al., "Depth map prediction from a single image using a multi-scale deep network", 2014.
    """

    depth: In[DepthImage] = In(doc="the depths to score")
    truth: Batch[DepthImage] = Batch(doc="the true depths at the same pixels")

    tolerance: Duration = Param("1ms", doc="farthest in time that the truth of an image may be")
    lateness: Duration = Param("1s", doc="truth may arrive so much later than the image it belongs to; kept in memory")
    max_range: float = Param(100.0, gt=0, doc="pixels whose true depth is farther are not judged", unit="m")

    def setup(self) -> None:
        self._pairing: Pairing[DepthImage, DepthImage] = Pairing(self.tolerance)
        self._errors: list[DepthErrors] = []

    def process(self, depth: DepthImage, truth: tuple[DepthImage, ...]) -> None:
        """Raises ValueError where result and truth have different sizes."""
        for true in truth:
            self._pairing.add_truth(true.stamp, true)
        self._pairing.add_found(depth.stamp, depth)
        self._judge(self._pairing.settle(depth.stamp - self.lateness))

    def finish(self) -> None:
        """Judges the images that waited for their truth."""
        self._judge(self._pairing.finish())

    def summary(self) -> Mapping[str, float | int | str]:
        figures: dict[str, float | int | str] = {
            "frames": self._pairing.pairs,
            "unmatched_depths": self._pairing.unmatched_found,
            "unmatched_truths": self._pairing.unmatched_truths,
            "frames_without_depth": sum(not e.measured for e in self._errors),
        }
        judged = sum(e.judged for e in self._errors)
        if judged:
            figures["measured"] = sum(e.measured for e in self._errors) / judged
        scored = [e for e in self._errors if e.measured]
        if not scored:
            return figures | {"rmse_m": "not computed: no pixel of the paired images has a depth and a true one"}
        return figures | {
            "rmse_m": float(np.mean([e.rmse for e in scored])),
            "worst_rmse_m": max(e.rmse for e in scored),
            "mean_relative_error": float(np.mean([e.relative for e in scored])),
            "median_relative_error": float(np.mean([e.middle for e in scored])),
            "within_25_percent": float(np.mean([e.near for e in scored])),
        }

    def _judge(self, pairs: list[tuple[DepthImage, DepthImage]]) -> None:
        limit = np.float32(self.max_range)
        for found, true in pairs:
            self._errors.append(depth_errors(found.data, np.where(true.data <= limit, true.data, 0)))


@dataclass(frozen=True)
class DepthErrors:
    """Figures of one image, over the pixels that both have; NaN where there is none."""

    judged: int  # pixels whose true depth is known
    measured: int  # of them, with a depth
    rmse: float  # metres
    relative: float  # mean of |error| / true depth
    middle: float  # median of the same
    near: float  # share with max(found / true, true / found) < 1.25


def depth_errors(found: Depth, true: Depth) -> DepthErrors:
    """Compares two images (H, W) of one view, metres, 0 or NaN for no return. Raises ValueError for two sizes."""
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
