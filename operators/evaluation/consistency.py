"""Normalised errors: how large an error is by the covariance that it was given with.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Odometry, Pose
from dataflow.messages.geometry import quaternion_to_matrix
from operators.estimation.chi_square import quantile
from operators.fusion.filter.error_state import log_rotation

Array = NDArray[np.float64]
Innovations = dict[str, tuple[float, int]]
"""By sensor: the sum of normalised innovations squared, and their degrees of freedom."""


def covariance_of(estimate: Pose | Odometry) -> Array | None:
    """Returns the covariance (6, 6) of a pose, None where there is none or it is not finite."""
    covariance = estimate.covariance if isinstance(estimate, Pose) else estimate.pose_covariance
    if covariance is None or not (np.isfinite(covariance).all() and np.isfinite(estimate.position).all()):
        return None
    return covariance


def pose_error(estimate: Pose | Odometry, truth: Pose | Odometry) -> Array:
    """Returns the error of position and of rotation about the fixed axes (6,)."""
    R = quaternion_to_matrix(estimate.orientation)
    turned = log_rotation(quaternion_to_matrix(truth.orientation) @ R.T)
    return np.concatenate([truth.position - estimate.position, turned])


def normalised(error: Array, covariance: Array, axes: Sequence[int]) -> tuple[float, int] | None:
    """Returns the normalised error squared along some axes, and its degrees of freedom; None if nothing is known.

    Axes whose variance is 0 or less (the height of a planar estimate) do not count.
    """
    known = [k for k in axes if covariance[k, k] > 0]
    chosen = covariance[np.ix_(known, known)]
    if not known or float(np.linalg.eigvalsh(chosen)[0]) <= 0:
        return None
    return float(error[known] @ np.linalg.solve(chosen, error[known])), len(known)


def band(freedom: int) -> tuple[float, float]:
    """Returns the limits between which the mean of an honest normalised error lies with 95 %, over its freedom."""
    low, high = quantile([0.025, 0.975], freedom) / freedom
    return float(low), float(high)


def innovations(status: Diagnostics) -> Innovations:
    """Returns each sensor's innovations by a filter's status: the values `nis` and `freedom`."""
    found: Innovations = {}
    for k, name in enumerate(status.names):
        values = status.pairs(k)
        if "nis" in values and "freedom" in values:
            found[name] = (float(values["nis"]), int(values["freedom"]))
    return found
