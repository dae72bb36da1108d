"""Scores odometry against ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np

from dataflow.messages import Odometry, Pose
from dataflow.operator import Batch, Duration, In, Operator, Param
from operators.evaluation.figures import Figures
from operators.evaluation.trajectory import (
    PoseLog,
    Trajectory,
    absolute_error,
    few_matched,
    match,
    path_length,
    relative_errors,
    segment_drift,
)


class TrajectoryMetrics(Figures, Operator):
    """Collects an estimated and a true trajectory and computes ATE and RPE when the estimate ends.

    Both must pose the same child frame; the frames they are expressed in may differ, which the alignment makes up for.
    Poses are paired after the fact, each with the truth nearest in time within `tolerance`: truth is a batch input, so
    it may come at any rate and late without delaying or dropping an estimate.

    Methods: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012; the alignment, Umeyama, 1991;
    the drift of segments, Geiger et al., "Are we ready for autonomous driving?", 2012.
    """

    estimate: In[Pose | Odometry] = In(doc="the poses to score")
    ground_truth: Batch[Pose | Odometry] = Batch(doc="the true poses of the same child frame")

    alignment: Literal["se3", "sim3", "none"] = Param(
        "se3", doc="moves the whole estimate onto the truth (Umeyama): rigidly, with scale, or not at all"
    )
    one_place: tuple[str, ...] = Param((), doc="child frames that count as one, such as base_footprint and base_link")
    tolerance: Duration = Param("1ms", doc="farthest in time that an estimate's truth may be")
    rpe_seconds: float = Param(1.0, gt=0, doc="span of the relative error over time", unit="s")
    rpe_metres: float = Param(1.0, gt=0, doc="span of the relative error over the true path", unit="m")
    drift_metres: tuple[float, ...] = Param(
        (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0),
        doc="lengths of the segments of the true path that the drift is the mean of, as KITTI has them; m",
    )
    out: str | None = Param(None, doc="folder for estimate.tum, ground_truth.tum and metrics.json; made if missing")

    def setup(self) -> None:
        super().setup()
        self._estimate, self._truth = PoseLog(), PoseLog()
        self._not_finite = self._truths_not_finite = 0

    def process(self, estimate: Pose | Odometry, ground_truth: tuple[Pose | Odometry, ...]) -> None:
        """Raises ValueError where estimate and truth pose different child frames."""
        for truth in ground_truth:
            names = {truth.child_frame, estimate.child_frame} - {""}
            if len(names) > 1 and not names <= set(self.one_place):
                raise ValueError(
                    f"the ground truth poses {truth.child_frame!r} but the estimate {estimate.child_frame!r}: "
                    f"both must pose the same frame, or `one_place` names both"
                )
            if np.isfinite(truth.position).all():
                self._truth.append(truth.stamp, truth.position, truth.orientation)
            else:
                self._truths_not_finite += 1
        if np.isfinite(estimate.position).all():
            self._estimate.append(estimate.stamp, estimate.position, estimate.orientation)
        else:
            self._not_finite += 1

    def finish(self) -> None:
        """Computes the figures and writes the files."""
        estimate, truth = self._estimate.trajectory(), self._truth.trajectory()
        matches = match(estimate, truth, self.tolerance)
        self._figures = {
            "matched": len(matches.estimate),
            "unmatched_estimates": matches.unmatched_estimates,
            "unmatched_truths": matches.unmatched_truths,
            "estimates_not_finite": self._not_finite,
            "path_m": path_length(matches.truth),
            "alignment": self.alignment,
        }
        if (text := few_matched(matches, estimate, truth, self.tolerance)) is not None:
            self._figures["matching"] = text
        if self._truths_not_finite:
            self._figures["truths_not_finite"] = self._truths_not_finite
        try:
            self._figures |= absolute_error(matches, self.alignment)
        except ValueError as error:
            self._figures["ate"] = f"not computed for {len(matches.estimate)} matched poses: {error}"
        self._figures |= relative_errors(matches, self.rpe_seconds, self.rpe_metres)
        self._figures |= segment_drift(matches, self.drift_metres)
        if self.out is not None:
            self._write(Path(self.out).expanduser(), estimate, truth)

    def _write(self, folder: Path, estimate: Trajectory, truth: Trajectory) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "estimate.tum").write_text(estimate.tum())
        (folder / "ground_truth.tum").write_text(truth.tum())
        (folder / "metrics.json").write_text(json.dumps(self._figures, indent=2) + "\n")
