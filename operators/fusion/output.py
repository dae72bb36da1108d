"""Output of the fusion: the pose of the base with its covariance, and the health of the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Odometry
from dataflow.messages.diagnostics import Level
from operators.fusion.filter.error_state import GYRO_BIAS, POSITION, ROTATION, SIZE, VELOCITY, State, cross
from operators.fusion.filter.error_state_filter import UNMEASURED
from operators.fusion.filter.gate import Health
from operators.fusion.filter.suspicions import LATE
from operators.geometry.se3 import skew
from operators.status import Row, status_of_rows

Array = NDArray[np.float64]
_I3 = np.eye(3)


def well_known(covariance: Array, sigma: float) -> bool:
    """Returns whether the position is known to `sigma` (m): its horizontal coordinates, and the height where anything
    measures it."""
    variances = np.diag(covariance)[POSITION]
    measured = variances < UNMEASURED**2
    return bool(measured[:2].all() and variances[measured].max() < sigma**2)


def unmeasured(covariance: Array) -> dict[str, str]:
    """Returns a warning where the height is of no use, since nothing has measured it."""
    x, y, z = np.sqrt(np.diag(covariance)[POSITION])
    if z < UNMEASURED or max(x, y) >= UNMEASURED:
        return {}
    return {"height": "nothing measures it (fixes without altitude): z of the odometry has no meaning"}


def suspicion_of(sensor: str, kind: str, size: float, sigma: float) -> dict[str, str]:
    """Returns a warning of a sensor's error that was not told: of its stamps (s), or of the scale of its speeds."""
    if kind == LATE:
        side = "late" if size > 0 else "early"
        text = f"its stamps are {abs(size):.2f} ± {sigma:.2f} s {side} (offset), if its place on the robot is right"
        return {sensor: text}
    side = "fast" if size > 0 else "slow"
    return {sensor: f"its speeds are {abs(size):.1%} ± {sigma:.1%} too {side} (scale_sigma)"}


def unsure_of_time(state: State, rate: Array, seconds: float) -> State:
    """Returns the state with a covariance that holds a delay of the whole (s); `rate` is the gyroscope's reading."""
    moves = np.zeros(len(state.covariance))
    moves[POSITION], moves[ROTATION] = state.velocity, rate - state.gyro_bias
    return replace(state, covariance=state.covariance + seconds**2 * np.outer(moves, moves))


def odometry_of(state: State, rate: Array, T_body_base: Array, stamp: int, frame: str, child_frame: str) -> Odometry:
    """Returns pose and velocity of the base; `rate` is the gyroscope's reading (3,)."""
    R, lever, turn = state.rotation, T_body_base[:3, 3], T_body_base[:3, :3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R @ turn, state.position + R @ lever
    pose = np.zeros((6, SIZE))
    at_lever = skew(lever)
    pose[:3, POSITION], pose[:3, ROTATION], pose[3:, ROTATION] = _I3, -R @ at_lever, R
    own, angular = R.T @ state.velocity, rate - state.gyro_bias
    twist = np.zeros((6, SIZE))
    twist[:3, VELOCITY], twist[:3, ROTATION] = turn.T @ R.T, turn.T @ skew(own)
    twist[:3, GYRO_BIAS], twist[3:, GYRO_BIAS] = turn.T @ at_lever, -turn.T
    P = state.covariance[:SIZE, :SIZE]
    return Odometry.from_matrix(
        T,
        stamp=stamp,
        frame=frame,
        child_frame=child_frame,
        linear=turn.T @ (own + cross(angular, lever)),
        angular=turn.T @ angular,
        pose_covariance=pose @ P @ pose.T,
        twist_covariance=twist @ P @ twist.T,
    )


def diagnostics(
    stamp: int,
    health: Mapping[str, Health],
    ignored: Mapping[str, int],
    offsets: Mapping[str, tuple[float, float]],
    warnings: Mapping[str, str],
) -> Diagnostics:
    """Returns a status for the filter, one for every sensor, and one for every warning, a text by what it is about.

    A warning with the name of a sensor, or `filter`, stands in its row.

    `offsets`: the estimated time offset of a sensor and its standard deviation, s. `nis` is the sum of the normalised
    innovations squared of all used measurements, and `freedom` its expectation for a consistent covariance.
    """
    level = Level.WARN if "filter" in warnings else Level.OK
    rows: list[Row] = [("filter", warnings.get("filter", "one hypothesis"), level, dict(ignored))]
    for name, h in sorted(health.items()):
        silent = h.last_used is None or stamp - h.last_used > 2e9
        if h.doubts and silent:
            level, text = Level.ERROR, warnings.get(name, "refused")
        elif name in warnings:
            level, text = Level.WARN, warnings[name]
        elif silent:
            level, text = Level.STALE, "silent"
        elif h.nis > 3:
            level, text = Level.WARN, "covariance too small"
        else:
            level, text = Level.OK, "used"
        counts = {"used": h.used, "made room for": h.widened, "refused": h.refused, "unconfirmed": h.unconfirmed}
        values: dict[str, int | str] = {**counts, "nis": f"{h.nis_sum:.3f}", "freedom": h.freedom}
        if (found := offsets.get(name.partition(" ")[0])) is not None:
            values |= {"offset, s": f"{found[0]:.4f}", "offset sigma, s": f"{found[1]:.4f}"}
        rows.append((name, text, level, values))
    rows += [(name, text, Level.WARN, {}) for name, text in sorted(warnings.items()) if name not in {"filter", *health}]
    return status_of_rows(stamp, rows)


def figures(
    health: Mapping[str, Health],
    offsets: Mapping[str, tuple[float, float]],
    unheard: Mapping[str, str],
    ignored: Mapping[str, int],
) -> Mapping[str, float | int | str]:
    """Sums up the filter's time: what was made of the measurements of each sensor, and what was ignored, by reason.

    `unheard`: settings that fit no stream, each with the stream that may have been meant.
    """
    found: dict[str, float | int | str] = {}
    for name, sensor in sorted(health.items()):
        found[f"{name}, used"] = sensor.used + sensor.widened
        found[f"{name}, used after making room"] = sensor.widened
        found[f"{name}, refused"] = sensor.refused
        found[f"{name}, unconfirmed"] = sensor.unconfirmed
    for name, (offset, sigma) in offsets.items():
        found |= {f"{name}, offset (s)": offset, f"{name}, sigma of the offset (s)": sigma}
    found |= {f"settings of {name}": f"of no stream{near}" for name, near in unheard.items()}
    return found | {f"ignored, {reason}": count for reason, count in sorted(ignored.items())}
