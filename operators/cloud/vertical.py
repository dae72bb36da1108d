"""Estimates the vertical of a cloud from its level and upright surfaces, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.cloud.filtering import Voxels, finite, in_range
from operators.cloud.normals import estimate_normals

Array = NDArray[np.float64]

_VOXEL = 0.06  # metres
_RANGE = 4.5  # metres: farther normals are noise
_FEWEST = 50  # voxels with a normal
_STRAY = 0.07  # radians by which normals of surfaces stray from level and upright, before they are looked at closely
_CLOSER = (0.07, 0.07, 0.05, 0.05, 0.035, 0.035)  # and in each round of the fit: what lies askew loses its say
_LEVEL, _UPRIGHT = 0.25, 0.25  # shares of surfaces that are so, before anything is seen
_CANDIDATES = 400
_VOICES = 6.0  # so much the normals of a view count against what is expected: they are of few surfaces
_APART = np.cos(np.radians(20.0))  # directions so far apart are different answers
_PATCH = 0.4  # metres: normals of one patch stray together
_DISTORTION = np.radians(0.7)  # by which a depth camera bends what is flat
_TOLERANCE, _GROWTH = 0.03, 0.004  # metres from a level surface, and times the squared distance, 1/m
_GROUND = 40  # voxels of a level surface that counts as ground
_BELOW = 0.05  # share of that number that lies below it at most


@dataclass(frozen=True, eq=False)
class Vertical:
    """The direction up (3,) in a cloud's frame with its covariance (3, 3), rad^2, and the height above the ground.

    `rival` is the likelihood of the best direction that is far from it, relative to this one's. `height` is that of the
    cloud's origin above the lowest level surface, in metres; None where no such surface is seen.
    """

    up: Array
    covariance: Array
    rival: float
    height: float | None

    @property
    def sigma(self) -> float:
        """Standard deviation of the direction in the way in which it is least sure, radians."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    def before(self, T_first_now: Array) -> Vertical:
        """Returns the same in the frame where the sensor was at first; `T_first_now` (4, 4) is how it moved since."""
        R, up = T_first_now[:3, :3], T_first_now[:3, :3] @ self.up
        height = None if self.height is None else self.height - float(up @ T_first_now[:3, 3])
        return Vertical(up, R @ self.covariance @ R.T, self.rival, height)


def find_vertical(points: NDArray[np.float32], expected: Array, information: Array) -> Vertical | None:
    """Returns the vertical of points (N, 3), metres, in their sensor's frame; None where they show too few surfaces.

    Most surfaces that people build are level or upright, so the directions of the normals tell where up is. Those that
    are seen are rated by the normals along them and across them, each patch of surface once, and by `expected` (3,),
    where up is likely, with its `information` (3, 3), rad^-2: how cameras are held, or what an accelerometer measured.
    The best one is refined by least squares. After Coughlan and Yuille, "Manhattan world", 1999, with a vertical alone.
    """
    usable = points[finite(points) & in_range(points, 0.1, _RANGE)]
    if len(usable) < _FEWEST:
        return None
    places = Voxels.by_size(usable, _VOXEL).means(usable)
    normals = estimate_normals(places, neighbours=16, radius=3.5 * _VOXEL, viewpoint=np.zeros(3))
    known = np.isfinite(normals).all(axis=1)
    places, normals = places[known], normals[known]
    if len(normals) < _FEWEST:
        return None
    weight = len(Voxels.by_size(places.astype(np.float32), _PATCH).counts) / len(places)
    candidates = np.concatenate([normals[:: 1 + len(normals) // _CANDIDATES], expected[None]])
    candidates *= np.where(candidates @ expected < 0, -1.0, 1.0)[:, None]
    away = candidates - expected
    ratings = _VOICES / len(normals) * _likelihoods(candidates, normals)
    ratings -= 0.5 * np.einsum("ij,jk,ik->i", away, information, away)
    best = int(np.argmax(ratings))
    others = ratings[candidates @ candidates[best] < _APART]
    rival = float(np.exp(others.max() - ratings[best])) if len(others) else 0.0
    up, covariance = _refined(candidates[best], normals, weight, expected, information)
    return Vertical(up, covariance, rival, _height(places, normals, up))


def _likelihoods(candidates: Array, normals: Array) -> Array:
    """Returns the log likelihood (K,) of normals (N, 3) where up is each of the candidates (K, 3)."""
    cosine = np.abs(candidates @ normals.T)
    level, upright = _densities(cosine, _STRAY)
    return np.asarray(np.log(level + upright + (1 - _LEVEL - _UPRIGHT)).sum(axis=1))


def _densities(cosine: Array, stray: float) -> tuple[Array, Array]:
    """Returns how often level and upright surfaces have such a cosine with up, relative to surfaces of any kind."""
    level = _LEVEL * np.exp((cosine - 1) / stray**2) / stray**2
    upright = _UPRIGHT * np.sqrt(2 / np.pi) * np.exp(-0.5 * (cosine / stray) ** 2) / stray
    return level, upright


def _refined(up: Array, normals: Array, weight: float, expected: Array, information: Array) -> tuple[Array, Array]:
    """Returns the direction that fits the normals best by reweighted least squares, and its covariance (3, 3)."""
    A = np.eye(3)
    for stray in _CLOSER:
        cosine = normals @ up
        level, upright = _densities(np.abs(cosine), stray)
        whole = level + upright + (1 - _LEVEL - _UPRIGHT)
        level, upright = weight * level / whole / stray**2, weight * upright / whole / stray**2
        across = np.eye(3) - np.outer(up, up)
        towards = normals * np.sign(cosine)[:, None]
        A = level.sum() * np.eye(3) + (normals * upright[:, None]).T @ normals + information
        b = level @ (towards - up) - (upright * cosine) @ normals + information @ (expected - up)
        step = np.linalg.solve(across @ A @ across + np.outer(up, up) * np.trace(A), across @ b)
        up = up + step
        up = up / np.linalg.norm(up)
    across = np.eye(3) - np.outer(up, up)
    inverse = np.linalg.inv(across @ A @ across + np.outer(up, up) * np.trace(A))
    return up, np.asarray(across @ inverse @ across + _DISTORTION**2 * across)


def _height(places: Array, normals: Array, up: Array) -> float | None:
    """Returns the height of the origin above the lowest level surface with next to nothing below it; None for none."""
    heights = places @ up
    tolerance = _TOLERANCE + _GROWTH * np.einsum("ij,ij->i", places, places)
    level = np.flatnonzero(normals @ up > 0.9)
    for at in np.sort(heights[level])[:: max(1, _GROUND // 4)].tolist():
        near = np.abs(heights[level] - at) <= tolerance[level]
        count = int(np.count_nonzero(near))
        if count < _GROUND:
            continue
        middle = float(np.median(heights[level][near]))
        below = int(np.count_nonzero(heights < middle - 3 * tolerance))
        return -middle if below <= _BELOW * count else None
    return None
