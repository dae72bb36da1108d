"""Rigid motions as (4, 4) matrices, with the right (body) perturbation T <- T exp([v, w]).

A twist is (6,): translation v in metres, then rotation w in radians. Solà et al., "A micro Lie theory", 2018.
"""

import math

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]
_I3 = np.eye(3)


def skew(v: Vector) -> Matrix:
    """Returns the (3, 3) matrix of the cross product v ×."""
    x, y, z = v.tolist()  # numbers are faster than arrays of three
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(twist: Vector) -> Matrix:
    """Returns the motion (4, 4) of a twist (6,)."""
    v, w = twist[:3], twist[3:]
    angle = math.sqrt(w.dot(w))
    W = skew(w)
    WW = W @ W
    if angle < 1e-6:
        a, b, c = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle**2
        c = (1.0 - a) / angle**2
    T = np.eye(4)
    T[:3, :3] += a * W + b * WW
    T[:3, 3] = (_I3 + b * W + c * WW) @ v
    return T


def log(T: Matrix) -> Vector:
    """Returns the twist (6,) of a motion (4, 4); |rotation| ≤ pi, at pi with either sign of the axis."""
    R, p = T[:3, :3], T[:3, 3]
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    vee = np.array([(zy - yz) / 2.0, (xz - zx) / 2.0, (yx - xy) / 2.0])
    sine, cosine = math.sqrt(vee.dot(vee)), (xx + yy + zz - 1.0) / 2.0
    angle = float(np.arctan2(sine, cosine))
    if angle < 1e-6:
        w = vee
    elif sine > 1e-6:
        w = vee * (angle / sine)
    else:  # half a turn: the axis is the largest column of R + I
        column = int(np.argmax(np.diag(R)))
        axis = R[:, column] + np.eye(3)[column]
        w = angle * axis / np.linalg.norm(axis)
    W = skew(w)
    d = 1.0 / 12.0 if angle < 1e-4 else (1.0 - angle / (2.0 * np.tan(angle / 2.0))) / angle**2
    return np.concatenate([(_I3 - 0.5 * W + d * (W @ W)) @ p, w])


def interpolated(T_a: Matrix, T_b: Matrix, share: float) -> Matrix:
    """Returns the motion (4, 4) on the way from T_a (share 0) to T_b (share 1) at a constant twist, or beyond."""
    a_inverse = np.eye(4)
    a_inverse[:3, :3], a_inverse[:3, 3] = T_a[:3, :3].T, -T_a[:3, :3].T @ T_a[:3, 3]
    return np.asarray(T_a @ exp(share * log(a_inverse @ T_b)))


def adjoint(T: Matrix) -> Matrix:
    """Returns the (6, 6) for which T exp(x) T^-1 = exp(adjoint(T) x)."""
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = skew(T[:3, 3]) @ R
    return out


def orthonormalised(T: Matrix) -> Matrix:
    """Returns the nearest rigid motions to nearly rigid matrices (..., 4, 4): products of many drift off SO(3)."""
    out = np.zeros_like(T)
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = nearest_rotation(T[..., :3, :3]), T[..., :3, 3], 1.0
    return out


def nearest_rotation(M: Matrix) -> Matrix:
    """Returns the rotations nearest to M (..., 3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(M)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(u @ vt)


def about_fixed_axes(covariance: Matrix, T_world_body: Matrix) -> Matrix:
    """Returns the covariance (6, 6) of (position, rotation about the world's axes) of that of a right perturbation."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T_world_body[:3, :3]
    return A @ covariance @ A.T
