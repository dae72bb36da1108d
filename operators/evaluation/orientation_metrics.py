"""Scores estimated orientations against ground truth, in heading and inclination as Laidig et al. (BROAD, 2021)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataflow.messages import Imu, Odometry, Pose, Transforms
from dataflow.messages.geometry import matrix_to_quaternion, normalize, quaternion_from_yaw, quaternion_multiply
from dataflow.operator import Batch, Duration, In, Operator, Param, Sampled
from operators.evaluation.figures import Figures
from operators.evaluation.pairing import Pairing
from operators.geometry.extrinsics import transform_between

Array = NDArray[np.float64]
Heading = Literal["absolute", "relative"]


def differences(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Returns the rotations (N, 4), in the world's axes, from true to estimated orientations (N, 4); x, y, z, w."""
    q = np.asarray(truth, np.float64)
    return normalize(quaternion_multiply(normalize(estimate), q * [-1, -1, -1, 1]))


def without_mean_heading(difference: Array) -> Array:
    """Returns rotations (N, 4) less the heading that they have in common: that by which their sum is turned."""
    _, _, z, w = difference.T
    # Twice the heading's half angle, averaged as directions: signs of quaternions do not matter.
    common = np.angle(np.sum((w + 1j * z) ** 2))
    return quaternion_multiply(quaternion_from_yaw(-common), difference)


def errors(difference: Array) -> tuple[Array, Array, Array]:
    """Returns total error, heading error and inclination error (N,) of rotations (N, 4), radians, all ≥ 0."""
    x, y, z, w = np.abs(difference.T)
    total = 2 * np.arctan2(np.sqrt(x * x + y * y + z * z), w)
    return total, 2 * np.arctan2(z, w), 2 * np.arctan2(np.hypot(x, y), np.hypot(z, w))


class OrientationMetrics(Figures, Operator):
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
        super().setup()
        self._pairing: Pairing[Array, Array] = Pairing(self.tolerance)

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
            self._pairing.add_truth(truth.stamp, q)
        if estimate.orientation is not None:
            self._pairing.add_found(estimate.stamp, estimate.orientation)

    def finish(self) -> None:
        """Computes the figures, degrees."""
        pairs = self._pairing.finish()
        self._figures = {"matched": len(pairs), "unmatched_truths": self._pairing.unmatched_truths}
        if not pairs:
            return
        difference = differences(*zip(*pairs, strict=True))
        if self.heading == "relative":
            difference = without_mean_heading(difference)
        for name, error in zip(("total", "heading", "inclination"), errors(difference), strict=True):
            self._figures[f"{name}_rmse_deg"] = float(np.degrees(np.sqrt((error**2).mean())))
            self._figures[f"{name}_max_deg"] = float(np.degrees(error.max()))
