"""The error-state Kalman filter of an inertial body: its state, its motion, and the update by an innovation.

The error is (15 + K,): position and velocity in the world's axes, rotation as a right perturbation R <- R exp(θ),
gyroscope bias, accelerometer bias, and K lasting errors of sensors. Solà, "Quaternion kinematics for the
error-state Kalman filter", 2017; Li and Mourikis, "Online temporal calibration for camera-IMU systems", 2014.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from operators.geometry.se3 import skew

Array = NDArray[np.float64]

POSITION, VELOCITY, ROTATION, GYRO_BIAS, ACCEL_BIAS = (slice(3 * k, 3 * k + 3) for k in range(5))
SIZE = 15
_I3, _I15 = np.eye(3), np.eye(SIZE)


@dataclass(frozen=True, eq=False)
class State:
    """An estimate: position (3,) and velocity (3,) in the world, R_world_body (3, 3), biases (3,), covariance.

    `errors` (K,): lasting errors of sensors, such as time offsets; `covariance` is (15 + K, 15 + K). `effects`
    (15 + K, S): how it changes with S things before, which is carried along with the motion. A
    body without inertial sensor has the angular velocity -gyro_bias: it is an inertial body whose sensor reads 0.
    """

    position: Array
    velocity: Array
    rotation: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    errors: Array = field(default_factory=lambda: np.zeros(0))
    effects: Array = field(default_factory=lambda: np.zeros((SIZE, 0)))


@dataclass(frozen=True)
class Noise:
    """Densities of white noise: gyroscope rad/s/√Hz, accelerometer m/s²/√Hz, and of the biases' random walks."""

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float


def exp_rotation(w: Array) -> Array:
    """Returns the rotation (3, 3) of a rotation vector (3,)."""
    x, y, z = w.tolist()
    square = x * x + y * y + z * z
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if square < 1e-12:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = square**0.5
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    return np.asarray(_I3 + a * W + b * (W @ W))


def cross(a: Array, b: Array) -> Array:
    """Returns a × b of two vectors (3,): np.cross takes ten times as long."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def log_rotation(R: Array) -> Array:
    """Returns the rotation vector (3,) of a rotation (3, 3)."""
    vee = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0
    sine, cosine = float(np.linalg.norm(vee)), (float(np.trace(R)) - 1.0) / 2.0
    if sine > 1e-6:
        return np.asarray(vee * (math.atan2(sine, cosine) / sine))
    if cosine > 0:
        return vee
    column = int(np.argmax(np.diag(R)))  # half a turn: the axis is the largest column of R + I
    axis = R[:, column] + _I3[column]
    return np.asarray(math.pi * axis / np.linalg.norm(axis))


@dataclass(frozen=True, eq=False)
class GaussMarkovProcess:
    """Holds how lasting errors of sensors change: rates of decay (K,) in 1/s, noise (K,) in their unit/√s."""

    decay: Array = field(default_factory=lambda: np.zeros(0))
    noise: Array = field(default_factory=lambda: np.zeros(0))


STEADY = GaussMarkovProcess()


def propagated(
    state: State,
    gyro: Array,
    accel: Array,
    seconds: float,
    noise: Noise,
    gravity: Array,
    wander: GaussMarkovProcess = STEADY,
) -> State:
    """Moves the state by the mean readings (rad/s, m/s²) of a short time; `gravity` (3,) in m/s²."""
    dt = seconds
    R = state.rotation
    force = accel - state.accel_bias
    turn = (gyro - state.gyro_bias) * dt
    middle = exp_rotation(turn / 2)
    half = R @ middle
    acceleration = half @ force + gravity
    step = exp_rotation(turn)
    F = _I15.copy()
    lever = R @ skew(middle @ force)
    _diagonal(F, 3)[:3] = dt  # of the position by the velocity
    F[POSITION, ROTATION] = lever * (-0.5 * dt * dt)
    F[POSITION, ACCEL_BIAS] = half * (-0.5 * dt * dt)
    F[VELOCITY, ROTATION] = lever * -dt
    F[VELOCITY, ACCEL_BIAS] = half * -dt
    F[VELOCITY, GYRO_BIAS] = lever * (0.5 * dt * dt)
    F[ROTATION, ROTATION] = step.T
    F[ROTATION, GYRO_BIAS] = middle.T * -dt
    left = 1.0 - wander.decay * dt
    G = _with_errors(F, left)
    P = np.asarray(G @ state.covariance @ G.T)
    own, shared = _spread(noise, dt)
    diagonal = _diagonal(P, 0)
    diagonal[:SIZE] += own
    if len(P) > SIZE:
        diagonal[SIZE:] += wander.noise**2 * dt
    _diagonal(P, 3)[:3] += shared
    _diagonal(P, -3)[:3] += shared
    return State(
        position=state.position + state.velocity * dt + 0.5 * acceleration * dt * dt,
        velocity=state.velocity + acceleration * dt,
        rotation=_orthonormal(R @ step),
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        covariance=P,
        errors=left * state.errors,
        effects=G @ state.effects if state.effects.size else state.effects,
    )


@lru_cache(maxsize=64)
def _spread(noise: Noise, seconds: float) -> tuple[Array, float]:
    """Returns the variances (15,) that noise adds in a short time, and the covariance of position and velocity."""
    a, g = noise.accel**2, noise.gyro**2
    of_block = [a * seconds**3 / 3, a * seconds, g * seconds]
    of_block += [noise.gyro_walk**2 * seconds, noise.accel_walk**2 * seconds]
    variances = np.repeat(of_block, 3)
    variances.flags.writeable = False  # it is kept
    return variances, a * seconds * seconds / 2


def _diagonal(square: Array, beside: int) -> Array:
    """Returns a diagonal of a matrix, `beside` columns to the right of the main one, as a view."""
    side = len(square)
    return square.reshape(-1)[beside if beside >= 0 else -beside * side :: side + 1]


def _with_errors(F: Array, left: Array) -> Array:
    """The transition (15 + K, 15 + K) by F (15, 15) of a state of whose sensors' errors a share (K,) is left."""
    if not len(left):
        return F
    G = np.diag(np.concatenate([np.ones(SIZE), left]))
    G[:SIZE, :SIZE] = F
    return np.asarray(G)


def shifted(state: State, rate: Array, acceleration: Array, seconds: float) -> State:
    """Moves pose and velocity by a moment, forth or back: `rate` (3,) in the body, `acceleration` (3,) in the world."""
    return replace(
        state,
        position=state.position + state.velocity * seconds,
        velocity=state.velocity + acceleration * seconds,
        rotation=state.rotation @ exp_rotation(rate * seconds),
    )


def moved(state: State, error: Array, covariance: Array | None = None) -> State:
    """Adds an error (15 + K,) to the state; the covariance stays unless another is given."""
    return State(
        position=state.position + error[POSITION],
        velocity=state.velocity + error[VELOCITY],
        rotation=_orthonormal(state.rotation @ exp_rotation(error[ROTATION])),
        gyro_bias=state.gyro_bias + error[GYRO_BIAS],
        accel_bias=state.accel_bias + error[ACCEL_BIAS],
        covariance=state.covariance if covariance is None else covariance,
        errors=state.errors + error[SIZE:],
    )


def difference(state: State, other: State) -> Array:
    """Returns the error (15 + K,) that brings `state` to `other`."""
    return np.concatenate(
        [
            other.position - state.position,
            other.velocity - state.velocity,
            log_rotation(state.rotation.T @ other.rotation),
            other.gyro_bias - state.gyro_bias,
            other.accel_bias - state.accel_bias,
            other.errors - state.errors,
        ]
    )


def updated(state: State, residual: Array, H: Array, R: Array) -> State:
    """Corrects the state by a residual (M,) with Jacobian (M, 15 + K) and covariance (M, M); Joseph's form."""
    P = state.covariance
    PH = P @ H.T
    K = np.linalg.solve(H @ PH + R, PH.T).T
    error = K @ residual
    unit = _I15 if len(P) == SIZE else np.eye(len(P))
    A = unit - K @ H
    P = A @ P @ A.T + K @ R @ K.T
    reset = unit.copy()  # the error is from now on one of the corrected rotation
    reset[ROTATION, ROTATION] -= 0.5 * skew(error[ROTATION])
    P = reset @ P @ reset.T
    return moved(state, error, 0.5 * (P + P.T))


def mahalanobis(state: State, residual: Array, H: Array, R: Array) -> tuple[float, float]:
    """Returns the normalised innovation squared, and the logarithm of the determinant of its covariance."""
    S = H @ state.covariance @ H.T + R
    L = np.linalg.cholesky(S)
    white = np.linalg.solve(L, residual)
    return float(white @ white), 2.0 * float(np.log(L.diagonal()).sum())


def _orthonormal(R: Array) -> Array:
    """Keeps a nearly orthonormal matrix so: one step of Newton's iteration for the nearest rotation."""
    return np.asarray(R @ (1.5 * _I3 - 0.5 * (R.T @ R)))
