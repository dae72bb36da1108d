"""Scores how honest the covariances of an estimate are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from dataflow.messages import Odometry, Pose
from dataflow.messages.geometry import quaternion_to_matrix
from dataflow.operator import Batch, Duration, In, Operator, Param
from operators.association import mutually_nearest
from operators.fusion.error_state import log_rotation

Array = NDArray[np.float64]


class ConsistencyMetrics(Operator):
    """Collects poses with covariance and the true ones, and computes the normalised estimation error squared (NEES).

    An honest covariance gives a mean of the degrees of freedom and 5 % above the bound. `anees` over freedom is 1 then;
    more is an estimate that believes itself too much, less one that believes itself too little. Errors that last are
    correlated, so the band of a single run, which takes one sample every `apart`, is only as good as that. Directions
    whose variance is 0 or less (the height of a planar estimate) do not count; `planar` takes x, y and heading alone.

    Method: Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 5.4.
    """

    estimate: In[Pose | Odometry] = In(doc="the poses to score, with covariance")
    ground_truth: Batch[Pose | Odometry] = Batch(doc="the true poses of the same child frame, in the same frame")

    planar: bool = Param(False, doc="score x, y and heading alone")
    apart: Duration = Param("1s", doc="time between samples that count as independent, for the band")
    tolerance: Duration = Param("1ms", doc="farthest in time that an estimate's truth may be")

    def setup(self) -> None:
        self._stamps: list[int] = []
        self._estimates: list[tuple[Array, Array, Array]] = []
        self._true_stamps: list[int] = []
        self._truths: list[tuple[Array, Array]] = []
        self._passed_over = 0
        self._figures: dict[str, float | int | str] = {}

    def process(self, estimate: Pose | Odometry, ground_truth: tuple[Pose | Odometry, ...]) -> None:
        """Raises ValueError where estimate and truth are of different frames."""
        for truth in ground_truth:
            for found, true, what in (
                (estimate.child_frame, truth.child_frame, "poses"),
                (estimate.frame, truth.frame, "is in"),
            ):
                if found and true and found != true:
                    raise ValueError(
                        f"the ground truth {what} {true!r} but the estimate {found!r}: covariances are of one frame, "
                        "so nothing is aligned"
                    )
            self._true_stamps.append(truth.stamp)
            self._truths.append((truth.position, quaternion_to_matrix(truth.orientation)))
        covariance = estimate.covariance if isinstance(estimate, Pose) else estimate.pose_covariance
        if covariance is None or not (np.isfinite(covariance).all() and np.isfinite(estimate.position).all()):
            self._passed_over += 1
            return
        self._stamps.append(estimate.stamp)
        self._estimates.append((estimate.position, quaternion_to_matrix(estimate.orientation), covariance))

    def on_reset(self, input: str) -> None:
        """A clock jumped back, so stamps do not tell any more what belongs together: the score begins anew."""
        self.setup()

    def finish(self) -> None:
        """Computes the figures."""
        pairs = mutually_nearest(self._stamps, self._true_stamps, self.tolerance)
        self._figures = {"matched": len(pairs), "estimates without finite covariance": self._passed_over}
        errors = [self._error(self._estimates[i], self._truths[j]) for i, j in pairs]
        stamps = np.array([self._stamps[i] for i, _ in pairs], np.int64)
        covariances = [self._estimates[i][2] for i, _ in pairs]
        parts = (
            {"pose": [0, 1, 5], "position": [0, 1], "heading": [5]}
            if self.planar
            else {"pose": list(range(6)), "position": [0, 1, 2], "orientation": [3, 4, 5]}
        )
        for name, axes in parts.items():
            self._score(name, axes, errors, covariances, stamps)

    def summary(self) -> Mapping[str, float | int | str]:
        return dict(self._figures)

    @staticmethod
    def _error(estimate: tuple[Array, Array, Array], truth: tuple[Array, Array]) -> Array:
        """Of position and of rotation about the fixed axes (6,)."""
        return np.concatenate([truth[0] - estimate[0], log_rotation(truth[1] @ estimate[1].T)])

    def _score(
        self, name: str, axes: list[int], errors: list[Array], covariances: list[Array], stamps: NDArray[np.int64]
    ) -> None:
        values, freedoms, times = [], [], []
        for error, covariance, stamp in zip(errors, covariances, stamps.tolist(), strict=True):
            known = [k for k in axes if covariance[k, k] > 0]
            chosen = covariance[np.ix_(known, known)]
            if known and float(np.linalg.eigvalsh(chosen)[0]) > 0:
                values.append(float(error[known] @ np.linalg.solve(chosen, error[known])))
                freedoms.append(len(known))
                times.append(stamp)
        if not values:
            self._figures[f"{name}_nees"] = "no covariance is positive"
            return
        found, freedom = np.array(values), np.array(freedoms)
        ratio = found / freedom
        self._figures[f"{name}_nees_mean"] = float(ratio.mean())
        self._figures[f"{name}_nees_median"] = float(np.median(ratio))
        self._figures[f"{name}_above_95_percent"] = float((found > chi2.ppf(0.95, freedom)).mean() * 100)
        chosen_samples: list[int] = []
        last = 0
        for k, stamp in enumerate(times):
            if not chosen_samples or stamp - last >= self.apart:
                chosen_samples.append(k)
                last = stamp
        total = int(freedom[chosen_samples].sum())
        low, high = chi2.ppf([0.025, 0.975], total) / total
        anees = float(found[chosen_samples].sum()) / total
        self._figures[f"{name}_anees"] = anees
        self._figures[f"{name}_band_95_percent"] = f"{low:.2f}-{high:.2f}, {'in' if low <= anees <= high else 'out'}"
