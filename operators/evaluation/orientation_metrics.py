"""Scores estimated orientations against ground truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Imu, Odometry, Pose, Transforms
from dataflow.messages.geometry import matrix_to_quaternion, quaternion_multiply
from dataflow.operator import Batch, Duration, In, Operator, Param, Sampled
from operators.association import mutually_nearest
from operators.evaluation.orientation_error import Heading, differences, errors, without_mean_heading
from operators.geometry.extrinsics import transform_between


class OrientationMetrics(Operator):
    """Collects estimated and true orientations and computes the RMSE of the total error, of heading and of inclination.

    Each estimate is paired with the truth nearest in time within `tolerance`. A truth that poses another frame of the
    robot is brought to the estimate's by the extrinsics.

    Method: Laidig et al., "BROAD: a benchmark for robust inertial orientation estimation", 2021.
    """

    estimate: In[Imu | Pose | Odometry] = In(doc="the orientations to score; a sample without one is passed over")
    ground_truth: Batch[Pose | Odometry] = Batch(doc="the true orientations")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the true and the estimated frame, where they differ"
    )

    heading: Heading = Param(
        "absolute", doc="relative takes away the mean heading error: for estimates that do not know north"
    )
    tolerance: Duration = Param("1ms", doc="farthest in time that an estimate's truth may be")

    def setup(self) -> None:
        self._stamps: list[int] = []
        self._estimates: list[np.ndarray] = []
        self._true_stamps: list[int] = []
        self._truths: list[np.ndarray] = []
        self._figures: dict[str, float | int | str] = {}

    def process(
        self,
        estimate: Imu | Pose | Odometry,
        ground_truth: tuple[Pose | Odometry, ...],
        extrinsics: Transforms | None = None,
    ) -> None:
        """Raises ValueError where no transform relates the true to the estimated frame."""
        posed = estimate.frame if isinstance(estimate, Imu) else estimate.child_frame
        for truth in ground_truth:
            q = truth.orientation
            if posed and truth.child_frame and truth.child_frame != posed:
                if extrinsics is None:
                    raise ValueError(
                        f"the ground truth orients {truth.child_frame!r} but the estimate {posed!r}: wire extrinsics"
                    )
                q = quaternion_multiply(
                    q, matrix_to_quaternion(transform_between(extrinsics, posed, truth.child_frame))
                )
            self._true_stamps.append(truth.stamp)
            self._truths.append(q)
        if estimate.orientation is not None:
            self._stamps.append(estimate.stamp)
            self._estimates.append(estimate.orientation)

    def on_reset(self, input: str) -> None:
        """A clock jumped back, so stamps do not tell any more what belongs together: the score begins anew."""
        self.setup()

    def finish(self) -> None:
        """Computes the figures, degrees."""
        pairs = mutually_nearest(self._stamps, self._true_stamps, self.tolerance)
        self._figures = {"matched": len(pairs), "unmatched_truths": len(self._true_stamps) - len(pairs)}
        if not pairs:
            return
        difference = differences([self._estimates[i] for i, _ in pairs], [self._truths[j] for _, j in pairs])
        if self.heading == "relative":
            difference = without_mean_heading(difference)
        for name, error in zip(("total", "heading", "inclination"), errors(difference), strict=True):
            self._figures[f"{name}_rmse_deg"] = float(np.degrees(np.sqrt((error**2).mean())))
            self._figures[f"{name}_max_deg"] = float(np.degrees(error.max()))

    def summary(self) -> Mapping[str, float | int | str]:
        return dict(self._figures)
