"""Two views of an unknown scene: the motion that explains how corners went from one to the other, and their points.

An essential matrix and a homography compete, and what neither can determine is named, not guessed: a camera that has
only turned, a view that hardly changed, a plane that allows two motions. Mur-Artal et al., "ORB-SLAM", 2015, IV.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.estimation.kernels import cauchy
from operators.geometry.pinhole import Pixels, Points, project, unproject
from operators.geometry.se3 import Matrix, nearest_rotation
from operators.odometry.features import Mask

PLANAR = 0.45  # share of the score above which the homography is believed
GATES = (5.99, 3.84)  # chi-square, 95 %: of two coordinates (homography), of one (essential)
CLEAR = 0.75  # share of the best motion's points that the second best may have
TURNING = 2.0  # sigmas by which corners are off in the median where a rotation alone explains them
SHARP = 0.3  # share of the corners that must become points


class TwoViewFailure(StrEnum):
    """Reasons for which two views do not determine a motion."""

    FEW = "too few corners are seen by both views"
    STILL = "the view has hardly changed"
    ROTATION = "pure rotation: corners have no parallax"
    DISAGREE = "the corners agree on no motion"
    AMBIGUOUS = "two motions explain the corners alike"
    FLAT = "too little parallax"


@dataclass(frozen=True)
class TwoViewConfig:
    """Settings of the initialisation, in pixels of the working image and radians."""

    sigma: float = 1.0  # pixels of a sighting
    min_points: int = 50
    parallax: float = 0.02  # radians by which corners are off in the median where a turn is all that is allowed

    def __post_init__(self) -> None:
        if self.min_points < 8 or not self.parallax > 0 or not self.sigma > 0:
            raise ValueError(
                f"TwoViewConfig needs min_points >= 8, parallax and sigma > 0, got {self.min_points}, {self.parallax} "
                f"and {self.sigma}"
            )


@dataclass(frozen=True, eq=False)
class TwoViews:
    """A motion whose translation has the length 1, and what the views then show."""

    T_second_first: Matrix
    points: Points  # (M, 3) in the first camera
    chosen: NDArray[np.int64]  # (M,) which of the corners they are
    parallax: float  # radians, median of these
    planar: bool  # whether a homography explained them


def two_views(first: Pixels, second: Pixels, K: Matrix, config: TwoViewConfig) -> TwoViews | TwoViewFailure:
    """Returns the motion between two views of the same corners (N, 2), in pixels, or why there is none."""
    if len(first) < config.min_points:
        return TwoViewFailure.FEW
    focal = float(K[0, 0])
    if float(np.median(np.linalg.norm(second - first, axis=1))) < config.parallax * focal:
        return TwoViewFailure.STILL
    # 1. A rotation alone.
    R = turned(unproject(first, K), unproject(second, K), config.sigma / focal)
    off = np.linalg.norm(project(unproject(first, K) @ R.T, K) - second, axis=1)
    unexplained = float(np.median(off))
    if unexplained < config.parallax * focal:
        return TwoViewFailure.ROTATION if unexplained < TURNING * config.sigma else TwoViewFailure.FLAT
    # 2. An essential matrix and a homography, by the share of the score that each deserves.
    E = _matrix(cv2.findEssentialMat(first, second, K, cv2.RANSAC, 0.999, config.sigma)[0])
    H = _matrix(cv2.findHomography(first, second, cv2.RANSAC, 2.0 * config.sigma, maxIters=500, confidence=0.999)[0])
    if E is None or H is None:
        return TwoViewFailure.DISAGREE
    score_E = _score(_epipolar(E, first, second, K), config.sigma, GATES[1])
    score_H = _score(_transfer(H, first, second), config.sigma, GATES[0])
    planar = score_H > PLANAR * (score_H + score_E)
    # 3. The motion that puts most points in front of both cameras.
    motions = _motions_of_plane(H, K) if planar else _motions(E)
    found = sorted((_judged(T, first, second, K, config) for T in motions), key=lambda f: -f.count)
    if not found or found[0].count < max(config.min_points, SHARP * len(first)):
        return TwoViewFailure.FLAT if found and found[0].ahead > 0.5 * len(first) else TwoViewFailure.DISAGREE
    best = found[0]
    if len(found) > 1 and found[1].count > CLEAR * best.count:
        return TwoViewFailure.AMBIGUOUS
    chosen = np.flatnonzero(best.good)
    return TwoViews(best.T, best.points[chosen], chosen, float(np.median(best.angles[chosen])), planar)


def turned(rays_a: Points, rays_b: Points, sigma: float) -> Matrix:
    """Returns the rotation (3, 3) that brings rays (N, 3) nearest to others, most of them: reweighted least squares."""
    a = rays_a / np.linalg.norm(rays_a, axis=1, keepdims=True)
    b = rays_b / np.linalg.norm(rays_b, axis=1, keepdims=True)
    weight, R = np.ones(len(a)), np.eye(3)
    for _ in range(10):
        R = nearest_rotation((weight[:, None] * b).T @ a)
        off = np.linalg.norm(a @ R.T - b, axis=1)
        weight = cauchy((off / max(3.0 * sigma, float(np.median(off)))) ** 2)
    return R


def triangulate(T_a: Matrix, T_b: Matrix, pixels_a: Pixels, pixels_b: Pixels, K: Matrix) -> tuple[Points, Points]:
    """Returns points (N, 3) in the world where rays of two cameras, T_world_camera, meet most nearly; and for each its
    depth in a, its depth in b and the angle of the rays (N, 3)."""
    a = unproject(pixels_a, K) @ T_a[:3, :3].T
    b = unproject(pixels_b, K) @ T_b[:3, :3].T
    base = T_b[:3, 3] - T_a[:3, 3]
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    da, db = a @ base, b @ base
    scale = np.maximum(aa * bb - ab * ab, 1e-12)
    za, zb = (da * bb - db * ab) / scale, (da * ab - db * aa) / scale
    points = 0.5 * (T_a[:3, 3] + za[:, None] * a + T_b[:3, 3] + zb[:, None] * b)
    angle = np.arctan2(np.sqrt(np.maximum(aa * bb - ab * ab, 0.0)), ab)
    return points, np.column_stack([za, zb, angle])


@dataclass(frozen=True, eq=False)
class _Judged:
    T: Matrix
    points: Points
    angles: NDArray[np.float64]
    good: Mask
    ahead: int

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.good))


def _judged(T_second_first: Matrix, first: Pixels, second: Pixels, K: Matrix, config: TwoViewConfig) -> _Judged:
    """Counts the corners that a motion turns into points: ahead of both cameras, where both see them, with parallax."""
    points, told = triangulate(np.eye(4), invert(T_second_first), first, second, K)
    ahead = (told[:, 0] > 0) & (told[:, 1] > 0)
    gate = (2.5 * config.sigma) ** 2
    fit = ahead & (((project(points, K) - first) ** 2).sum(axis=1) < gate)
    fit &= ((project(transform_points(T_second_first, points), K) - second) ** 2).sum(axis=1) < gate
    good = fit & (told[:, 2] > 0.4 * config.parallax)
    return _Judged(T_second_first, points, told[:, 2], np.asarray(good, np.bool_), int(np.count_nonzero(fit)))


def _matrix(found: Any) -> Matrix | None:
    """Returns a model of OpenCV's as (3, 3), None where it found none or several."""
    return None if found is None or np.shape(found) != (3, 3) else np.asarray(found, np.float64)


def _motions(E: Matrix) -> list[Matrix]:
    R1, R2, t = cv2.decomposeEssentialMat(E)
    return [_motion(R, sign * np.asarray(t)) for R in (R1, R2) for sign in (1.0, -1.0)]


def _motions_of_plane(H: Matrix, K: Matrix) -> list[Matrix]:
    """Each solution with the translation as it stands: its normal gives the side of the plane."""
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, K)
    found = [(R, t) for R, t in zip(rotations, translations, strict=True) if np.linalg.norm(t) > 1e-6]
    return [_motion(R, np.asarray(t)) for R, t in found]


def _motion(R: Any, t: NDArray[Any]) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t.ravel() / np.linalg.norm(t)
    return T


def _score(squared: NDArray[np.float64], sigma: float, gate: float) -> float:
    """Returns the sum over both directions (2, N) of how far squared errors stay below a gate."""
    chi = squared / sigma**2
    return float(np.where(chi < gate, GATES[0] - chi, 0.0).sum())


def _epipolar(E: Matrix, first: Pixels, second: Pixels, K: Matrix) -> NDArray[np.float64]:
    """Returns squared distances (2, N) from the epipolar lines, in pixels."""
    inverse = np.linalg.inv(K)
    F = inverse.T @ E @ inverse
    a, b = np.column_stack([first, np.ones(len(first))]), np.column_stack([second, np.ones(len(second))])
    lines_b, lines_a = a @ F.T, b @ F
    product = (b * lines_b).sum(axis=1) ** 2
    return np.stack([product / np.maximum((line[:, :2] ** 2).sum(axis=1), 1e-18) for line in (lines_b, lines_a)])


def _transfer(H: Matrix, first: Pixels, second: Pixels) -> NDArray[np.float64]:
    """Returns squared distances (2, N) of the corners from where a homography, and its inverse, puts them."""
    out = []
    for G, a, b in ((H, first, second), (np.linalg.inv(H), second, first)):
        p = np.column_stack([a, np.ones(len(a))]) @ G.T
        z = np.where(np.abs(p[:, 2]) > 1e-9, p[:, 2], 1e-9)
        out.append(((p[:, :2] / z[:, None] - b) ** 2).sum(axis=1))
    return np.stack(out)
