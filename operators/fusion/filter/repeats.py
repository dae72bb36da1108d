"""Positions that repeat: a receiver that hangs gives its last one with new stamps, which is no new measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operators.estimation.chi_square import quantile
from operators.fusion.filter.error_state import VELOCITY, State
from operators.fusion.filter.measurements import FullPose, Measurement, Position

Array = NDArray[np.float64]
_MOVES = 0.999
"""Share of a resting body's velocities that are no larger by their covariance."""


@dataclass(frozen=True, eq=False)
class Repeat:
    """Holds a sensor's last position (3,), when it first came (ns), and whether it fitted then.

    `speed`: of the body (m/s) when it came again, 0 where it may have been at rest; `frozen`: the body has left it.
    """

    place: Array
    since: int
    fitted: bool = True
    speed: float = 0.0
    frozen: bool = False


def repeat_of(before: Repeat | None, entry: Measurement, state: State, fits: bool) -> Repeat | None:
    """Returns what a measurement repeats, by the estimate of its time; None for one that is of no place.

    `fits`: it agrees with the estimate. What disagreed when it first came shows nothing: the estimate may be wrong.
    Bit for bit the same place is no fault of a body at rest, or of one that has braked since. It stops counting where
    the body should have gone further than the sensor's standard deviation, and is a fault beyond three.
    """
    if not isinstance(entry.model, Position | FullPose):
        return None
    place = entry.model.value if isinstance(entry.model, Position) else entry.model.place
    if before is None or not np.array_equal(place, before.place, equal_nan=True):
        return Repeat(place, entry.time, fits)
    covariance = state.covariance[VELOCITY, VELOCITY]
    now, sigma = float(np.linalg.norm(state.velocity)), float(np.trace(covariance)) ** 0.5
    speed = 0.0 if now + 3.0 * sigma < 0.5 * before.speed else before.speed
    moves = state.velocity @ np.linalg.solve(covariance, state.velocity) > quantile(_MOVES, 3)
    way = now * (entry.time - before.since) * 1e-9 / float(np.trace(entry.noise[:2, :2])) ** 0.5
    if before.fitted and not speed and moves and way > 1.0:
        speed = now
    return replace(before, speed=speed, frozen=before.frozen or (speed > 0 and way > 3.0))
