"""Decides whether a measurement is believed: a chi-square gate that neither locks out a sensor nor falls for one
outlier.

A measurement that does not fit is refused. So is, until another agrees with it, one that fits only because the filter
knows much less than the sensor (after an outage, an outlier fits as well). When refused measurements agree with each
other, it is the filter that is wrong: room is made for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from operators.estimation.chi_square import quantile
from operators.fusion.error_state import GYRO_BIAS, POSITION, ROTATION, VELOCITY, State

Array = NDArray[np.float64]
Verdict = Literal["used", "widened", "refused", "unconfirmed"]


@dataclass(frozen=True)
class GateConfig:
    """The rules of a gate.

    `share`: of true measurements that fit; `agreeing`: how many that do not fit must agree until they are believed;
    `surplus`: one must be confirmed where the filter's variance is so many times the sensor's; `memory`: seconds for
    which a doubtful one counts; `drift`: m/s by which the filter's place may go wrong meanwhile.
    """

    share: float = 0.999
    agreeing: int = 3
    surplus: float = 9.0
    memory: float = 3.0
    drift: float = 0.3


@dataclass(frozen=True, eq=False)
class Doubt:
    """A measurement that was not believed: its time (ns), residual (M,) and covariance (M, M)."""

    time: int
    residual: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class Health:
    """Counts of a sensor's measurements by their fate.

    `nis`: normalised innovation squared over its degrees of freedom, lately; `nis_sum`, `freedom`: of all used.
    """

    used: int = 0
    widened: int = 0
    refused: int = 0
    unconfirmed: int = 0
    last_used: int | None = None
    nis: float = 1.0
    doubts: tuple[Doubt, ...] = ()
    nis_sum: float = 0.0
    freedom: int = 0

    def after(self, verdict: Verdict, time: int, nis: float, doubt: Doubt, config: GateConfig) -> Health:
        """Returns the health after a verdict on a measurement with a normalised innovation squared."""
        freedom = len(doubt.residual)
        if verdict == "used":
            smooth = 0.98 * self.nis + 0.02 * nis / freedom
            sums = self.nis_sum + nis, self.freedom + freedom
            return Health(self.used + 1, self.widened, self.refused, self.unconfirmed, time, smooth, (), *sums)
        counted = replace(self, **{verdict: getattr(self, verdict) + 1})
        if verdict == "widened":
            return replace(counted, last_used=time, doubts=())
        kept = [d for d in self.doubts if time - d.time <= config.memory * 1e9][-16:]
        return replace(counted, doubts=(*kept, doubt))


@lru_cache(maxsize=64)
def threshold(share: float, freedom: int) -> float:
    """Returns the quantile of chi-square, remembered: the same few are asked for at each measurement."""
    return float(quantile(share, freedom))


def judge(
    config: GateConfig, doubts: Sequence[Doubt], doubt: Doubt, state: State, H: Array, normalised: float
) -> Verdict:
    """Decides about a measurement: `doubt` is what it would be if not believed, `normalised` its NIS."""
    fits = normalised <= threshold(config.share, len(doubt.residual))
    known = np.einsum("ij,jk,ik->i", H, state.covariance, H)
    if fits and not (known > config.surplus * doubt.noise.diagonal()).any():
        return "used"
    needed = 1 if fits else config.agreeing - 1
    if sum(_agree(config, d, doubt, state, H) for d in doubts) >= needed:
        return "used" if fits else "widened"
    return "unconfirmed" if fits else "refused"


def _agree(config: GateConfig, before: Doubt, now: Doubt, state: State, H: Array) -> bool:
    seconds = abs(now.time - before.time) * 1e-9
    if seconds > config.memory or len(before.residual) != len(now.residual):
        return False
    velocity = state.covariance[VELOCITY, VELOCITY] + config.drift**2 * np.eye(3)
    turning = state.covariance[GYRO_BIAS, GYRO_BIAS]
    drift = H[:, POSITION] @ velocity @ H[:, POSITION].T + H[:, ROTATION] @ turning @ H[:, ROTATION].T
    apart = now.residual - before.residual
    off = float(apart @ np.linalg.solve(before.noise + now.noise + drift * seconds**2, apart))
    return off <= threshold(config.share, len(apart))
