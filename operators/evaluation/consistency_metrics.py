"""Scores how honest the covariances of an estimate are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Odometry, Pose
from dataflow.operator import Batch, Duration, In, Operator, Param, Sampled
from operators.estimation.chi_square import quantile
from operators.evaluation.consistency import Innovations, band, covariance_of, innovations, normalised, pose_error
from operators.evaluation.figures import Figures
from operators.evaluation.pairing import Pairing

Array = NDArray[np.float64]


class ConsistencyMetrics(Figures, Operator):
    """Collects poses with covariance and the true ones, and computes the normalised estimation error squared (NEES).

    An honest covariance gives a mean of the degrees of freedom and 5 % above the bound. `anees` over freedom is 1 then;
    more is an estimate that believes itself too much, less one that believes itself too little. Errors that last are
    correlated, so the band of a single run, which takes one sample every `apart`, is only as good as that. Directions
    whose variance is 0 or less (the height of a planar estimate) do not count; `planar` takes x, y and heading alone.

    With the status of the filter (EkfFusion's), the normalised innovations squared (NIS) of each sensor are judged the
    same way: `nis` over freedom is 1 for a sensor with the right covariance. Refused measurements are not in it.

    Method: Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 5.4.
    """

    estimate: In[Pose | Odometry] = In(doc="the poses to score, with covariance")
    ground_truth: Batch[Pose | Odometry] = Batch(doc="the true poses of the same child frame, in the same frame")

    status: Sampled[Diagnostics] = Sampled(required=False, doc="the filter's status, with its innovations")

    planar: bool = Param(False, doc="score x, y and heading alone")
    apart: Duration = Param("1s", doc="time between samples that count as independent, for the band")
    tolerance: Duration = Param("1ms", doc="farthest in time that an estimate's truth may be")

    def setup(self) -> None:
        super().setup()
        self._pairing: Pairing[tuple[Pose | Odometry, Array], Pose | Odometry] = Pairing(self.tolerance)
        self._innovations: Innovations = {}
        self._passed_over = self._truths_not_finite = 0

    def process(
        self, estimate: Pose | Odometry, ground_truth: tuple[Pose | Odometry, ...], status: Diagnostics | None = None
    ) -> None:
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
            if not (np.isfinite(truth.position).all() and np.isfinite(truth.orientation).all()):
                self._truths_not_finite += 1
                continue
            self._pairing.add_truth(truth.stamp, truth)
        if status is not None:
            self._innovations |= innovations(status)
        covariance = covariance_of(estimate)
        if covariance is None:
            self._passed_over += 1
        else:
            self._pairing.add_found(estimate.stamp, (estimate, covariance))

    def finish(self) -> None:
        """Computes the figures."""
        pairs = self._pairing.finish()
        self._figures = {"matched": len(pairs), "estimates without finite covariance": self._passed_over}
        if self._truths_not_finite:
            self._figures["truths not finite"] = self._truths_not_finite
        found = [(estimate.stamp, pose_error(estimate, truth), C) for (estimate, C), truth in pairs]
        parts = (
            {"pose": [0, 1, 5], "position": [0, 1], "heading": [5]}
            if self.planar
            else {"pose": list(range(6)), "position": [0, 1, 2], "orientation": [3, 4, 5]}
        )
        for name, axes in parts.items():
            self._score(name, axes, found)
        for sensor, (total, freedom) in sorted(self._innovations.items()):
            if freedom:
                self._judge(f"{sensor}, nis", f"{sensor}, nis_band_95_percent", total, freedom)

    def _score(self, name: str, axes: list[int], pairs: list[tuple[int, Array, Array]]) -> None:
        """Scores an estimate's axes by stamp, error (6,) and covariance (6, 6) of every pair."""
        values, freedoms, times = [], [], []
        for stamp, error, covariance in pairs:
            if (one := normalised(error, covariance, axes)) is not None:
                values.append(one[0])
                freedoms.append(one[1])
                times.append(stamp)
        if not values:
            self._figures[f"{name}_nees"] = "no covariance is positive"
            return
        found, freedom = np.array(values), np.array(freedoms)
        ratio = found / freedom
        self._figures[f"{name}_nees_mean"] = float(ratio.mean())
        self._figures[f"{name}_nees_median"] = float(np.median(ratio))
        self._figures[f"{name}_above_95_percent"] = float((found > quantile(0.95, freedom)).mean() * 100)
        chosen: list[int] = []
        for k, stamp in enumerate(times):
            if not chosen or stamp - times[chosen[-1]] >= self.apart:
                chosen.append(k)
        self._judge(f"{name}_anees", f"{name}_band_95_percent", float(found[chosen].sum()), int(freedom[chosen].sum()))

    def _judge(self, mean: str, limits: str, total: float, freedom: int) -> None:
        low, high = band(freedom)
        ratio = total / freedom
        self._figures[mean] = ratio
        self._figures[limits] = f"{low:.2f}-{high:.2f}, {'in' if low <= ratio <= high else 'out'}"
