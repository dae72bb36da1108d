"""Places beyond what a filter expects: it is brought there first, since doubles do not hold a variance of (10⁷ m)²."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import POSITION, State, moved
from operators.fusion.filter.gate import PLACES

Array = NDArray[np.float64]
FARTHEST = 1000.0
"""Standard deviation of a first position, m: the room that is made for a place is no larger."""
UNMEASURED = FARTHEST / 2
"""Standard deviation of a coordinate (m) that nothing has measured yet: half of what it begins with."""


def unplaced(state: State, kind: str) -> bool:
    """Returns whether a measurement by a model of this name is the first that places the body."""
    return kind in PLACES and bool((np.diag(state.covariance)[POSITION][:2] >= UNMEASURED**2).all())


def brought(state: State, residual: Array, H: Array) -> State:
    """Returns the state moved to the measured place, with the covariance that it had."""
    error = np.zeros(len(state.covariance))
    error[POSITION] = H[:, POSITION].T @ residual
    return moved(state, error)


def bounded(residual: Array, H: Array) -> tuple[Array, bool]:
    """Returns the residual for which room is made, shortened to FARTHEST, and whether it was longer."""
    places = H[:, POSITION].any(axis=1)
    length = float(np.linalg.norm(residual[places]))
    if length <= FARTHEST:
        return residual, False
    return np.where(places, residual * (FARTHEST / length), residual), True
