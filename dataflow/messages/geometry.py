"""Rotations and rigid transforms: quaternions (x, y, z, w), matrices (4, 4); `T_a_b` maps b to a coordinates.

Compose with `@`: `T_world_camera = T_world_base @ T_base_camera`. All functions are pure, take any leading dimensions,
work in float64 and do not normalise what they are given unless they say so.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dataflow.messages.arrays import F64


def quaternion_to_matrix(quaternion: npt.ArrayLike) -> F64:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first."""
    q = normalize(quaternion)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    matrix = np.empty((*q.shape[:-1], 3, 3))
    matrix[..., 0, 0] = 1 - 2 * (y * y + z * z)
    matrix[..., 0, 1] = 2 * (x * y - w * z)
    matrix[..., 0, 2] = 2 * (x * z + w * y)
    matrix[..., 1, 0] = 2 * (x * y + w * z)
    matrix[..., 1, 1] = 1 - 2 * (x * x + z * z)
    matrix[..., 1, 2] = 2 * (y * z - w * x)
    matrix[..., 2, 0] = 2 * (x * z - w * y)
    matrix[..., 2, 1] = 2 * (y * z + w * x)
    matrix[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return matrix


def matrix_to_quaternion(matrix: npt.ArrayLike) -> F64:
    """Unit quaternions (..., 4) with w ≥ 0 of rotation matrices (..., 3, 3), or of the rotations of (..., 4, 4).

    Shepperd's method (1978): the largest of the four squared components is the divisor, so that no rotation is
    ill-conditioned.
    """
    m = np.asarray(matrix, np.float64)[..., :3, :3]
    if m.ndim == 2:
        quaternion = normalize(_four_components(*m.ravel().tolist()))
        return -quaternion if quaternion[3] < 0 else quaternion
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack([1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz], axis=-1)
    symmetric_xy, symmetric_xz, symmetric_yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    skew_x, skew_y, skew_z = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    candidates = np.stack(  # row k is 4 * component k * (x, y, z, w)
        [
            np.stack([squares[..., 0], symmetric_xy, symmetric_xz, skew_x], axis=-1),
            np.stack([symmetric_xy, squares[..., 1], symmetric_yz, skew_y], axis=-1),
            np.stack([symmetric_xz, symmetric_yz, squares[..., 2], skew_z], axis=-1),
            np.stack([skew_x, skew_y, skew_z, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = squares.argmax(axis=-1)[..., None, None]
    quaternion = normalize(np.take_along_axis(candidates, best, axis=-2)[..., 0, :])
    return np.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def _four_components(
    xx: float, xy: float, xz: float, yx: float, yy: float, yz: float, zx: float, zy: float, zz: float
) -> tuple[float, float, float, float]:
    """Returns the quaternion of one rotation, times four of its largest component: numbers are faster than arrays."""
    squares = [1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz]
    best = squares.index(max(squares))
    if best == 0:
        return squares[0], xy + yx, xz + zx, zy - yz
    if best == 1:
        return xy + yx, squares[1], yz + zy, xz - zx
    if best == 2:
        return xz + zx, yz + zy, squares[2], yx - xy
    return zy - yz, xz - zx, yx - xy, squares[3]


def normalize(quaternion: npt.ArrayLike) -> F64:
    """Quaternions (..., 4), or any vectors, divided by their norms."""
    q = np.asarray(quaternion, np.float64)
    return np.asarray(q / np.sqrt((q * q).sum(axis=-1, keepdims=True)))


def quaternion_multiply(first: npt.ArrayLike, second: npt.ArrayLike) -> F64:
    """Hamilton products (..., 4): the rotation `second` followed by `first`, as matrices multiply."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    ax, ay, az, aw = (a[..., i] for i in range(4))
    bx, by, bz, bw = (b[..., i] for i in range(4))
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def quaternion_from_yaw(yaw: npt.ArrayLike) -> F64:
    """Quaternions (..., 4) of rotations about z by `yaw` (...), radians."""
    half = np.asarray(yaw, np.float64) / 2
    return np.stack([np.zeros_like(half), np.zeros_like(half), np.sin(half), np.cos(half)], axis=-1)


def yaw_of(quaternion: npt.ArrayLike) -> F64:
    """Heading (...) of quaternions (..., 4): the angle of the rotated x axis in the x-y plane, radians in [-π, π]."""
    x, y, z, w = np.moveaxis(normalize(quaternion), -1, 0)
    return np.asarray(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))


def roll_pitch_yaw(rotation: npt.ArrayLike) -> F64:
    """Returns the angles (3,), radians, of a rotation (3, 3): about the fixed axes x, y and z, one after the other."""
    R = np.asarray(rotation, np.float64)
    return np.array(
        [np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(np.clip(R[2, 0], -1.0, 1.0)), np.arctan2(R[1, 0], R[0, 0])]
    )


def transform_matrix(position: npt.ArrayLike, orientation: npt.ArrayLike) -> F64:
    """Rigid transforms (..., 4, 4) of translations (..., 3) and quaternions (..., 4)."""
    rotation = quaternion_to_matrix(orientation)
    matrix = np.zeros((*rotation.shape[:-2], 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = position
    matrix[..., 3, 3] = 1.0
    return matrix


def split_matrix(matrix: npt.ArrayLike) -> tuple[F64, F64]:
    """Translation (..., 3) and quaternion (..., 4) of rigid transforms (..., 4, 4)."""
    m = np.asarray(matrix, np.float64)
    return m[..., :3, 3].copy(), matrix_to_quaternion(m)


def invert(matrix: npt.ArrayLike) -> F64:
    """Inverses of rigid transforms (..., 4, 4): `T_b_a` of `T_a_b`."""
    m = np.asarray(matrix, np.float64)
    transposed = np.swapaxes(m[..., :3, :3], -1, -2)
    inverse = np.zeros_like(m)
    inverse[..., :3, :3] = transposed
    inverse[..., :3, 3] = -(transposed @ m[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(matrix: npt.ArrayLike, points: npt.ArrayLike) -> F64:
    """Points (N, 3) in b mapped by `T_a_b` (4, 4) to (N, 3) in a."""
    m, p = np.asarray(matrix, np.float64), np.asarray(points, np.float64)
    return np.asarray(p @ m[:3, :3].T + m[:3, 3])
