"""Silhouettes with what is true of them: what the posture network is trained on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.kept_arrays import KeptArrays

POSTURES = ("standing", "walking", "sitting_down", "sitting", "standing_up", "reaching", "drinking")
"""Activities of persons that a single look tells something of."""
BODY = 18
"""Values that tell a posture: five joints (right, away, up), where the chest points (away, right), the lean."""


@dataclass(frozen=True, eq=False)
class Postures(KeptArrays):
    """`silhouettes` (N, 3, S, S) in 127ths, `bodies` (N, BODY) metres and radians, `activities` (N,) of POSTURES."""

    silhouettes: NDArray[np.int8]
    bodies: NDArray[np.float32]
    activities: NDArray[np.int64]
