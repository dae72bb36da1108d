"""Depth images against LiDAR scans: the transform and the scale that make the two lie on each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.estimation.kernels import huber
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

_STEP = 2  # pixels to the neighbours that a surface's normal is taken from
_SMOOTH = 0.05  # neighbours on one surface differ by less than this share of the depth
_NEAR, _FAR = 0.4, 6.0  # metres
_REACH = 0.2  # a return farther from the surface than this share of the depth is of another one
_KNEE, _NOISE = 0.1, 0.02  # metres: beyond the knee a residual counts linearly; standard deviation of a residual
_ALIKE = 30  # returns whose errors are alike
_KEEP = 0.9  # share of the information that is kept at every pair
_FEWEST = 30  # returns on surfaces that a pair must have
_PRIOR = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 0.1])  # m, rad, share: standard deviations before anything is seen


@dataclass(frozen=True)
class DepthScanErrors:
    """Holds estimated errors of the LiDAR's extrinsic and of the scale of depths, with standard deviations.

    `turn` (3,) rad and `shift` (3,) m are what must be put on the LiDAR's points, in the depth camera's axes; `scale`
    is the share by which depths are too long.
    """

    shift: Array
    turn: Array
    scale: float
    sigmas: Array
    """(7,): of shift, turn and scale."""

    @property
    def angle(self) -> float:
        """The turn's magnitude, rad."""
        return float(np.linalg.norm(self.turn))

    @property
    def distance(self) -> float:
        """The shift's magnitude, m."""
        return float(np.linalg.norm(self.shift))


class DepthScanAgreement(Remembered):
    """Follows, pair by pair, the misfit of depth images and scans by point-to-plane alignment with forgetting.

    Each pair is aligned from where the last ones led, and its information is added to theirs, whose weight falls.
    Directions that the surfaces do not constrain stay at zero, within a prior. Method: projective association
    as in Blais and Levine, "Registering multiview range data to create 3D computer objects", 1995, with the scale as
    one more unknown.
    """

    _x: Array
    _information: Array
    pairs: int

    def __init__(self) -> None:
        self._x = np.zeros(7)
        self._information = np.zeros((7, 7))
        self.pairs = 0

    def add(self, depth: Depth, K: Array, points: Array, T_depth_lidar: Array) -> bool:
        """Takes a depth image (H, W) metres with its K, and points (N, 3) of the same time in the LiDAR's frame.

        False where they share too few surfaces.
        """
        self._information *= _KEEP
        T = se3.exp(self._x[:6]) @ T_depth_lidar
        found = _residuals(depth, 1.0 + self._x[6], K, points @ T[:3, :3].T + T[:3, 3])
        if found is None:
            return False
        residuals, J = found
        weights = huber(residuals, _KNEE) / (_NOISE**2 * _ALIKE)
        weighted = J * weights[:, None]
        self._information += np.einsum("ni,nj->ij", weighted, J)
        gradient = weighted.T @ residuals + self._x / _PRIOR**2
        self._x = self._x + gauss_newton_step(self._posterior(), gradient)
        self.pairs += 1
        return True

    def misfit(self) -> DepthScanErrors:
        """Returns the misfit by the pairs so far."""
        sigmas = np.sqrt(np.diag(np.linalg.inv(self._posterior())))
        return DepthScanErrors(self._x[:3].copy(), self._x[3:6].copy(), float(self._x[6]), sigmas)

    def _posterior(self) -> Array:
        return self._information + np.diag(1.0 / _PRIOR**2)


def _residuals(depth: Depth, scale: float, K: Array, points: Array) -> tuple[Array, Array] | None:
    """Distances (M,) of points (N, 3) in the depth camera's frame from the surfaces of the image, depths taken `scale`
    times too long, and their derivatives (M, 7) by shift, turn and scale. None where there are too few."""
    height, width = depth.shape
    points = points[(points[:, 2] > _NEAR) & (points[:, 2] < _FAR * (1 + _REACH))]
    u = np.rint(points[:, 0] / points[:, 2] * K[0, 0] + K[0, 2]).astype(np.intp)
    v = np.rint(points[:, 1] / points[:, 2] * K[1, 1] + K[1, 2]).astype(np.intp)
    inside = (u >= _STEP) & (u < width - _STEP) & (v >= _STEP) & (v < height - _STEP)
    points, u, v = points[inside], u[inside], v[inside]
    around = [(0, 0), (-_STEP, 0), (_STEP, 0), (0, -_STEP), (0, _STEP)]
    z = np.stack([depth[v + dv, u + du] for du, dv in around]).astype(np.float64) / scale
    z[~np.isfinite(z)] = 0
    centre = z[0]
    smooth = (np.abs(z[1:] - centre) < _SMOOTH * centre).all(axis=0) & (z > 0).all(axis=0)
    usable = smooth & (centre > _NEAR) & (centre < _FAR) & (np.abs(points[:, 2] - centre) < _REACH * centre)
    if np.count_nonzero(usable) < _FEWEST:
        return None
    points, u, v, z = points[usable], u[usable], v[usable], z[:, usable]
    on = [
        np.column_stack([(u + du - K[0, 2]) / K[0, 0] * d, (v + dv - K[1, 2]) / K[1, 1] * d, d])
        for (du, dv), d in zip(around, z, strict=True)
    ]
    normals = np.cross(on[2] - on[1], on[4] - on[3])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    residuals = np.einsum("ni,ni->n", normals, points - on[0])
    J = np.column_stack([normals, np.cross(points, normals), np.einsum("ni,ni->n", normals, on[0])])
    return residuals, J
