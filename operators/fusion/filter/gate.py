"""Decides whether a measurement is believed: a chi-square gate that neither locks out a sensor nor falls for one
outlier.

A measurement that does not fit is refused. So is, until another agrees with it, one that fits only because the filter
is much less certain than the sensor (after an outage, an outlier fits as well). When refused measurements agree with
each other for a time, the filter is wrong: room is made for them, unless they leapt in a way that the inertial sensor
would have felt. Then a witness of another kind is needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from operators.estimation.chi_square import quantile
from operators.fusion.filter.error_state import GYRO_BIAS, POSITION, ROTATION, VELOCITY, State
from operators.fusion.filter.measurements import FullPose, Measurement, Position

Array = NDArray[np.float64]
Verdict = Literal["used", "widened", "refused", "unconfirmed"]
NEVER_AGREE = 1_000_000
"""`agreeing` of a gate that never yields."""
PLACES = ("Position", "FullPose")
"""Kinds of measurements that place the body."""
_MOVES = 0.999
"""Share of a resting body's velocities that are no larger by their covariance."""


@dataclass(frozen=True)
class GateConfig:
    """The rules of a gate.

    `share`: of true measurements that fit; `agreeing`: how many that do not fit must agree until they are believed, and
    `lasting`: for how many seconds; `surplus`: one must be confirmed where the filter's variance is so many times the
    sensor's; `memory`: seconds for which a doubtful one counts; `drift`: m/s by which the filter's place may go wrong
    meanwhile.
    """

    share: float = 0.999
    agreeing: int = 3
    surplus: float = 9.0
    memory: float = 3.0
    drift: float = 0.3
    lasting: float = 1.0


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


@dataclass(frozen=True, eq=False)
class RejectedMeasurement:
    """A measurement that was not believed: its time (ns), residual (M,), covariance (M, M), and its model's name."""

    time: int
    residual: Array
    noise: Array
    kind: str = ""


@dataclass(frozen=True, eq=False)
class Health:
    """Counts of a sensor's measurements by their fate.

    `nis`: normalised innovation squared over its degrees of freedom, lately; `nis_sum`, `freedom`: of all used.
    `streak`: refused since one was last believed; `leap`: by how much (m or m/s) they leapt without the inertial
    sensor feeling it; `room`: when the filter last made room (ns); `repeat`: the position that it gives of late.
    """

    used: int = 0
    widened: int = 0
    refused: int = 0
    unconfirmed: int = 0
    last_used: int | None = None
    nis: float = 1.0
    doubts: tuple[RejectedMeasurement, ...] = ()
    nis_sum: float = 0.0
    freedom: int = 0
    streak: int = 0
    leap: float = 0.0
    room: int | None = None
    repeat: Repeat | None = None

    @property
    def idle(self) -> bool:
        """Returns whether the sensor repeats a position while the body moves."""
        return self.repeat is not None and self.repeat.speed > 0

    @property
    def frozen(self) -> bool:
        """Returns whether the sensor repeats a position that the body has left."""
        return self.repeat is not None and self.repeat.frozen

    @property
    def contradicts(self) -> bool:
        """Returns whether the sensor's measurements were refused too often in a row for chance."""
        return self.frozen or self.streak >= (2 if self.leap else 3)

    def after(
        self, verdict: Verdict, time: int, nis: float, doubt: RejectedMeasurement, config: GateConfig, leap: float = 0.0
    ) -> Health:
        """Returns the health after a verdict on a measurement with a normalised innovation squared."""
        freedom = len(doubt.residual)
        if verdict == "used":
            smooth = 0.98 * self.nis + 0.02 * nis / freedom
            sums = self.nis_sum + nis, self.freedom + freedom
            counts = self.used + 1, self.widened, self.refused, self.unconfirmed
            return Health(*counts, time, smooth, (), *sums, room=self.room, repeat=self.repeat)
        counted = replace(self, **{verdict: getattr(self, verdict) + 1})
        if verdict == "widened":
            return replace(counted, last_used=time, doubts=(), streak=0, leap=0.0, room=time)
        kept = [d for d in self.doubts if time - d.time <= config.memory * 1e9]
        kept = kept[:1] + kept[1:][-15:]  # the first gives the time for which they agree
        streak = (self.streak if kept else 0) + (verdict == "refused")
        return replace(counted, doubts=(*kept, doubt), streak=streak, leap=leap)


@lru_cache(maxsize=64)
def threshold(share: float, freedom: int) -> float:
    """Returns the quantile of chi-square, remembered: the same few are asked for at each measurement."""
    return float(quantile(share, freedom))


def judge(
    config: GateConfig,
    doubts: Sequence[RejectedMeasurement],
    doubt: RejectedMeasurement,
    state: State,
    H: Array,
    normalised: float,
    never: bool,
    idle: bool = False,
) -> Verdict:
    """Decides about a measurement: `doubt` is what it would be if not believed, `normalised` its NIS.

    `never`: refused even where it agrees with those before it, since the inertial sensor contradicts it; `idle`: it
    only repeats the one before.
    """
    if never:
        return "refused"
    if idle:
        return "unconfirmed"
    fits = normalised <= threshold(config.share, len(doubt.residual))
    known = np.einsum("ij,jk,ik->i", H, state.covariance, H)
    if fits and not (known > config.surplus * doubt.noise.diagonal()).any():
        return "used"
    agreeing = [d.time for d in doubts if _agree(config, d, doubt, state, H)]
    if fits:
        return "used" if agreeing else "unconfirmed"
    if len(agreeing) < config.agreeing - 1 or doubt.time - min(agreeing) < config.lasting * 1e9:
        return "refused"
    return "widened"


def leap(
    config: GateConfig,
    sensor: str,
    doubt: RejectedMeasurement,
    health: Mapping[str, Health],
    state: State,
    H: Array,
    normalised: float,
    unfelt: float,
) -> float:
    """Returns by how much (m or m/s) a sensor has leapt that the inertial sensor did not feel, 0 if it has not.

    A leap begins with the first measurement that is refused. It lasts until the sensor is nearer to where it was
    expected than to what was refused last, or has gone on for as far again, or something of another kind agrees with
    it, or the filter's own errors have come to be as large. One device leaps under all its names:
    wheels that stand say so by a speed, a standstill and no turn, in turns. A sensor of a kind that the filter never
    yields to does not leap. `unfelt`: standard deviation (m/s²) of what the inertial sensor may fail to feel.
    """
    own, fits = health.get(sensor, Health()), normalised <= threshold(config.share, len(doubt.residual))
    beside = 0.0 if fits or config.agreeing >= NEVER_AGREE else _beside(config, sensor, doubt, health)
    if config.agreeing >= NEVER_AGREE or doubt.kind not in (*PLACES, "Velocity"):
        return beside
    if fits and not own.leap:
        return 0.0
    if doubt.kind == "FullPose":  # the rotation aside, of which an acceleration is no witness
        doubt, H = replace(doubt, residual=doubt.residual[:3], noise=doubt.noise[:3, :3]), H[:3]
    recent = [d.residual[: len(doubt.residual)] for d in own.doubts if doubt.time - d.time <= config.memory * 1e9]
    size = own.leap if recent and len(recent[-1]) == len(doubt.residual) else 0.0
    if size:
        back = _squared(doubt.residual, doubt.noise) < _squared(doubt.residual - recent[-1], doubt.noise)
        astray = float(np.linalg.norm(doubt.residual)) > 2 * size  # and no constant, so it may as well be the filter
        if back or astray or size**2 <= np.trace(H @ state.covariance @ H.T + doubt.noise):
            size = 0.0
    moving = health.get(sensor.removesuffix(" standstill"), own)  # wheels that stop speak under another name
    last = max(own.last_used or 0, moving.last_used or 0)
    begins = not fits and last and not recent  # what goes astray bit by bit has not leapt
    if begins and _leaps(config, doubt, state, H, unfelt, (doubt.time - last) * 1e-9):
        size = float(np.linalg.norm(doubt.residual))
    size = size or (0.0 if recent else beside)
    return 0.0 if size and _witnessed(config, sensor, doubt, health) else size


def _beside(config: GateConfig, sensor: str, doubt: RejectedMeasurement, health: Mapping[str, Health]) -> float:
    """Returns by how much the same device has leapt lately under another name, 0 if it has not."""
    device = sensor.partition(" ")[0]
    return max(
        (
            other.leap
            for name, other in health.items()
            if name != sensor and name.partition(" ")[0] == device and other.doubts
            and doubt.time - other.doubts[-1].time <= config.lasting * 1e9
        ),
        default=0.0,
    )  # fmt: skip


def _squared(residual: Array, covariance: Array) -> float:
    return float(residual @ np.linalg.solve(covariance, residual))


def _leaps(
    config: GateConfig, doubt: RejectedMeasurement, state: State, H: Array, acceleration: float, seconds: float
) -> bool:
    """Returns whether a measurement does not fit even an inertial sensor that erred by an acceleration (m/s², σ).

    It may have erred for the `seconds` since the sensor was last believed.
    """
    room = np.zeros_like(state.covariance)
    speed, way = acceleration * seconds, 0.5 * acceleration * seconds**2
    room[POSITION, POSITION], room[VELOCITY, VELOCITY] = np.eye(3) * way**2, np.eye(3) * speed**2
    room[POSITION, VELOCITY] = room[VELOCITY, POSITION] = np.eye(3) * way * speed
    S = H @ (state.covariance + room) @ H.T + doubt.noise
    return _squared(doubt.residual, S) > threshold(config.share, len(doubt.residual))


def _witnessed(config: GateConfig, sensor: str, doubt: RejectedMeasurement, health: Mapping[str, Health]) -> bool:
    """Returns whether another sensor's refused positions, of another kind, agree with this one."""
    if doubt.kind not in PLACES:
        return False
    for name, other in health.items():
        if name == sensor or other.streak < config.agreeing or not other.doubts:
            continue
        last = other.doubts[-1]
        recent = doubt.time - last.time <= config.lasting * 1e9
        if (
            recent
            and last.kind in PLACES
            and last.kind != doubt.kind
            and min(map(len, (last.residual, doubt.residual))) >= 3
        ):
            apart = doubt.residual[:3] - last.residual[:3]
            noise = doubt.noise[:3, :3] + last.noise[:3, :3] + np.eye(3) * config.drift**2
            if _squared(apart, noise) <= threshold(config.share, 3):
                return True
    return False


def _agree(config: GateConfig, before: RejectedMeasurement, now: RejectedMeasurement, state: State, H: Array) -> bool:
    seconds = abs(now.time - before.time) * 1e-9
    if seconds > config.memory or len(before.residual) != len(now.residual):
        return False
    velocity = state.covariance[VELOCITY, VELOCITY] + config.drift**2 * np.eye(3)
    turning = state.covariance[GYRO_BIAS, GYRO_BIAS]
    drift = H[:, POSITION] @ velocity @ H[:, POSITION].T + H[:, ROTATION] @ turning @ H[:, ROTATION].T
    apart = now.residual - before.residual
    return _squared(apart, before.noise + now.noise + drift * seconds**2) <= threshold(config.share, len(apart))


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
