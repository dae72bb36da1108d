"""Robust kernels: weights of residuals in reweighted least squares, 1 for small ones and less for larger ones.

Zhang, "Parameter estimation techniques: a tutorial with application to conic fitting", 1997.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cauchy(squared: Array) -> Array:
    """Returns weights of squared residuals in units of the squared width, at which the weight is a half."""
    return np.asarray(1.0 / (1.0 + squared))


def geman_mcclure(squared: Array) -> Array:
    """Returns weights of squared residuals in units of the squared width, at which the weight is a quarter."""
    return np.asarray(1.0 / (1.0 + squared) ** 2)


def huber(residuals: Array, width: float) -> Array:
    """Returns weights of residuals that count linearly beyond a width in their unit."""
    return np.asarray(np.minimum(1.0, width / np.maximum(np.abs(residuals), 1e-9)))
