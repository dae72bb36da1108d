"""Rigid motions and twists, many at once: what `operators.geometry.se3` has for one at a time, where speed counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def skews(v: Array) -> Array:
    """Returns the matrices (N, 3, 3) of the cross products v ×, of vectors (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return np.asarray(out - out.transpose(0, 2, 1))


def exps(twists: Array) -> Array:
    """Returns the motions (N, 4, 4) of twists (N, 6)."""
    v, w = twists[:, :3], twists[:, 3:]
    angle = np.linalg.norm(w, axis=1)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    c = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (1.0 - a) / safe**2)
    W = skews(w)
    WW = W @ W
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    T[:, :3, :3] += a[:, None, None] * W + b[:, None, None] * WW
    V = np.eye(3) + b[:, None, None] * W + c[:, None, None] * WW
    T[:, :3, 3] = np.einsum("nij,nj->ni", V, v)
    return T


def logs(T: Array) -> Array:
    """Returns the twists (N, 6) of motions (N, 4, 4); |rotation| ≤ pi, at pi with either sign of the axis."""
    R, p = T[:, :3, :3], T[:, :3, 3]
    vee = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2.0
    sine, cosine = np.linalg.norm(vee, axis=1), (np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.arctan2(sine, cosine)
    small, straight = angle < 1e-6, (angle >= 1e-6) & (sine <= 1e-6)
    scale = np.where(small | straight, 1.0, angle / np.where(sine > 0, sine, 1.0))
    w = vee * scale[:, None]
    for i in np.flatnonzero(straight):  # half a turn: the axis is the largest column of R + I
        column = int(np.argmax(np.diag(R[i])))
        axis = R[i, :, column] + np.eye(3)[column]
        w[i] = angle[i] * axis / np.linalg.norm(axis)
    W = skews(w)
    tiny = angle < 1e-4
    safe = np.where(tiny, 1.0, angle)
    d = np.where(tiny, 1.0 / 12.0, (1.0 - safe / (2.0 * np.tan(safe / 2.0))) / safe**2)
    V_inverse = np.eye(3) - 0.5 * W + d[:, None, None] * (W @ W)
    return np.concatenate([np.einsum("nij,nj->ni", V_inverse, p), w], axis=1)


def adjoints(T: Array) -> Array:
    """Returns the matrices (N, 6, 6) for which T exp(x) T^-1 = exp(adjoint(T) x)."""
    R = T[:, :3, :3]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, :3, 3:] = skews(T[:, :3, 3]) @ R
    return out


def right_jacobians_inverse(twists: Array) -> Array:
    """Returns J (N, 6, 6) for which log(exp(e) exp(x)) ≈ e + J x, of twists e (N, 6); to the third order in e."""
    V, W = skews(twists[:, :3]), skews(twists[:, 3:])
    ad = np.zeros((len(twists), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = W
    ad[:, :3, 3:] = V
    return np.asarray(np.eye(6) + ad / 2.0 + ad @ ad / 12.0)
