"""Estimates the vertical of a cloud from its level and upright surfaces and what is expected, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

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
_CEILING = 0.2  # so often what faces down is seen, relative to what faces up
_CANDIDATES = 400
_ALIKE = np.cos(np.radians(12.0))  # normals of one direction
_SQUARE = np.log(6.0)  # so much likelier is a second wall square to the first than at any other angle
_DIRECTIONS, _ASKEW = 6, 0.5  # walls by twos with up between them, and the sine of the angle that they must form
_SHARE = 0.1  # of the normals, from which those of one direction count fully
_APART = np.cos(np.radians(20.0))  # directions so far apart are different answers
_PATCH = 0.4  # metres: normals of one patch stray together
_DISTORTION = np.radians(0.7)  # by which a depth camera bends what is flat
_TOLERANCE, _GROWTH = 0.03, 0.004  # metres from a level surface, and times the squared distance, 1/m
_GROUND = 40  # voxels of a level surface that counts as ground
_BELOW = 0.05  # share of that number that lies below it at most
_HIGHEST, _TOO_HIGH = 2.2, np.log(10.0)  # metres, and by how much less likely a camera is held higher
_FAR_BEHIND = 5.0  # log likelihood by which another answer is none
_DOWN = np.radians(20.0)  # cameras look down at what is near, by as much in the mean
_PITCH, _ROLL = np.radians(25.0), np.radians(12.0)  # standard deviations
_STANDARD = 9.81  # m/s²
_TILT = np.radians(1.5)  # standard deviation of an accelerometer's vertical at rest: bias and mounting
_RIVAL = 0.1  # likelihood of another direction, from which a view does not decide
_SURE = np.radians(4.0)  # standard deviation from which it does not either


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

    @property
    def doubt(self) -> float:
        """The doubt that is left: up to 1 the view decides."""
        return float(max(self.rival / _RIVAL, self.sigma / _SURE))

    def before(self, T_first_now: Array) -> Vertical:
        """Returns the same in the frame where the sensor was at first; `T_first_now` (4, 4) is how it moved since."""
        R, up = T_first_now[:3, :3], T_first_now[:3, :3] @ self.up
        height = None if self.height is None else self.height - float(up @ T_first_now[:3, 3])
        return Vertical(up, R @ self.covariance @ R.T, self.rival, height)


def held() -> tuple[Array, Array]:
    """Returns up (3,) and its information (3, 3), rad^-2, of a camera that a person carries or a robot bears."""
    up = np.array([0.0, -np.cos(_DOWN), -np.sin(_DOWN)])
    ahead, right = np.array([0.0, -np.sin(_DOWN), np.cos(_DOWN)]), np.array([1.0, 0.0, 0.0])
    return up, np.outer(ahead, ahead) / _PITCH**2 + np.outer(right, right) / _ROLL**2


def accelerated(force: Array) -> tuple[Array, Array]:
    """Returns the same of a specific force (3,), m/s², in that frame: less sure the more its size is not gravity's."""
    size = float(np.linalg.norm(force))
    if size < 0.5 * _STANDARD:
        return held()
    up, motion = force / size, abs(size - _STANDARD) / _STANDARD
    return up, (np.eye(3) - np.outer(up, up)) / (_TILT**2 + motion**2)


def find_vertical(points: NDArray[np.float32], expected: Array, information: Array) -> Vertical | None:
    """Returns the vertical of points (N, 3), metres, in their sensor's frame; None where they show too few surfaces.

    Most surfaces that people build are level or upright, so the directions of the normals show where up is. Those that
    are seen, and those square to two of them, are rated by the normals along them and across them, each direction of
    normals once, and by `expected` (3,), where up is likely, with its `information` (3, 3), rad^-2: how cameras are
    held, or what an accelerometer measured. Walls are likely square to each other, ceilings seldom seen, cameras seldom
    held above a head. The best one is refined by least squares. After Coughlan and Yuille, "Manhattan world", 1999.
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
    directions, weights = _voices(normals)
    candidates = _candidates(normals, directions, expected)
    away = candidates - expected
    away *= (np.arccos(np.clip(candidates @ expected, -1, 1)) / np.maximum(np.linalg.norm(away, axis=1), 1e-9))[:, None]
    ratings = _likelihoods(candidates, normals, weights)
    ratings -= 0.5 * np.einsum("ij,jk,ik->i", away, information, away)
    answers: list[tuple[float, Array]] = []
    while len(ratings) and (not answers or ratings.max() > answers[0][0] - _FAR_BEHIND):
        best = candidates[int(np.argmax(ratings))]
        height = _height(places, normals, best)
        answers.append((float(ratings.max()) - (_TOO_HIGH if height is not None and height > _HIGHEST else 0), best))
        apart = candidates @ best < _APART
        candidates, ratings = candidates[apart], ratings[apart]
    answers.sort(key=lambda answer: -answer[0])
    rival = float(np.exp(answers[1][0] - answers[0][0])) if len(answers) > 1 else 0.0
    up, covariance = _refined(answers[0][1], normals, weight, expected, information)
    return Vertical(up, covariance, rival, _height(places, normals, up))


def _candidates(normals: Array, directions: Array, expected: Array) -> Array:
    """Returns directions that may be up (K, 3): of normals, square to two of their directions, and the expected one."""
    square = np.array([np.cross(a, b) for a, b in combinations(directions[:_DIRECTIONS], 2)]).reshape(-1, 3)
    square = square[np.linalg.norm(square, axis=1) > _ASKEW]
    square /= np.linalg.norm(square, axis=1, keepdims=True)
    candidates = np.concatenate([normals[:: 1 + len(normals) // _CANDIDATES], square, expected[None]])
    return np.asarray(candidates * np.where(candidates @ expected < 0, -1.0, 1.0)[:, None])


def _voices(normals: Array) -> tuple[Array, Array]:
    """Returns the directions (D, 3) of normals (N, 3), and the weights (N,) of these, by which all of one direction are
    one observation: a wall has its normal once."""
    weights, directions = np.zeros(len(normals)), []
    left = np.arange(len(normals))
    while len(left):
        candidates = normals[left[:: 1 + len(left) // _CANDIDATES]]
        near = np.abs(candidates @ normals[left].T) > _ALIKE
        best = int(np.argmax(near.sum(axis=1)))
        own = near[best]
        weights[left[own]] = min(1.0, own.sum() / (_SHARE * len(normals))) / own.sum()
        directions.append(candidates[best])
        left = left[~own]
    return np.array(directions), weights


def _likelihoods(candidates: Array, normals: Array, weights: Array) -> Array:
    """Returns the log likelihood (K,) of normals (N, 3) with weights (N,) where up is each of the candidates (K, 3)."""
    cosine = candidates @ normals.T
    level, upright = _densities(np.abs(cosine), _STRAY)
    level *= np.where(cosine < 0, _CEILING, 1.0)
    whole = level + upright + (1 - _LEVEL - _UPRIGHT)
    walls = upright / whole * weights
    beside = np.cross(candidates, np.eye(3)[np.argmin(np.abs(candidates), axis=1)])
    around = beside @ normals.T + 1j * (np.cross(candidates, beside) @ normals.T)
    fourfold = (around / np.maximum(np.abs(around), 1e-12)) ** 4  # alike for walls that are square to each other
    square = np.abs((walls * fourfold).sum(axis=1)) / np.maximum(walls.sum(axis=1), 1e-12)
    return np.asarray(np.log(whole) @ weights + _SQUARE * square**4 * np.maximum(walls.sum(axis=1) - 1, 0))


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
