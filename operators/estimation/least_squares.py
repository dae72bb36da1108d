"""The step of Gauss and Newton that all iterations of least squares here take."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def gauss_newton_step(H: NDArray[Any], gradient: NDArray[Any]) -> NDArray[np.float64]:
    """Returns the step (N,) to the minimum of a quadratic of matrix H (N, N) and gradient (N,).

    Raises LinAlgError where H is singular.
    """
    return np.asarray(-np.linalg.solve(H, gradient), np.float64)
