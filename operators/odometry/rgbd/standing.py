"""Tells what stands still from what has moved, among features that a recognised view has in common with the map.

Points of both agree by a decimetre, so one pose between two may fit a wall and a robot before it that has moved by less
than a metre. Their pixels and depths together agree far closer, on one body alone: the one of the largest surface
stands still. Poses of three points (Ke and Roumeliotis, 2017), by truncated residuals (Torr and Zisserman, "MLESAC",
2000).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import Points, project
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.alignment import PixelTerm, PriorTerm, align
from operators.odometry.rgbd.fitting import Fitter, Sighting

Array = NDArray[np.float64]

SAMPLES = 200  # triples of features
BEST = 5  # poses of these that are fitted to all features that agree
ROUNDS = 3
APART = 10.0  # working pixels between features of one triple
PIXEL = 0.5  # working pixels by which recognised features err, where tracks err less
BEYOND = 11.3  # squared sigmas, 99 % of three degrees of freedom: a feature beyond is of another body
WEAK = 1e-3 * np.eye(6)  # information that keeps a fit of few features from running away


def standing(sighting: Sighting, seen: Points, fitter: Fitter, fewest: int) -> Sighting:
    """Returns a sighting without the features on a body that has moved, which it names as contrary.

    `seen` (N, 3) are the features' points by the view's own depth. Where no `fewest` different features agree on a
    pose, the sighting stays as it is.
    """
    body = _body(sighting, seen, fitter)
    if body is None or _count(sighting, body[1]) < fewest:
        return sighting
    T, agree = body
    rest = _part(sighting, ~agree)
    other = _body(rest, seen[~agree], fitter)
    still = replace(_part(sighting, agree), T_world_camera=T)
    if other is None or _count(rest, other[1]) < fewest:
        return still
    return replace(still, contrary=seen[~agree][other[1]])


def _part(sighting: Sighting, chosen: NDArray[np.bool_]) -> Sighting:
    return replace(
        sighting, points_world=sighting.points_world[chosen], pixels=sighting.pixels[chosen], ages=sighting.ages[chosen]
    )


def _count(sighting: Sighting, chosen: NDArray[np.bool_]) -> int:
    """Returns how many different features are chosen; one may have come with several keyframes."""
    return len(np.unique(sighting.pixels[chosen], axis=0))


def _body(sighting: Sighting, seen: Points, fitter: Fitter) -> tuple[Matrix, NDArray[np.bool_]] | None:
    """Returns the pose on which the most surface agrees, and which features (N,) do."""
    poses = _drawn(sighting, fitter)
    if not poses:
        return None
    area = seen[:, 2] ** 2

    def cost(T: Matrix) -> float:
        return float(area @ np.minimum(_squared(T, sighting, seen, fitter), BEYOND))

    fitted = []
    for T in sorted(poses, key=cost)[:BEST]:
        for _ in range(ROUNDS):
            agree = _squared(T, sighting, seen, fitter) < BEYOND
            if np.count_nonzero(agree) < 4:
                break
            T = align(T, [_term(_part(sighting, agree), fitter)], PriorTerm(T, WEAK), 5).T_world_camera
        fitted.append(T)
    best = min(fitted, key=cost)
    return best, _squared(best, sighting, seen, fitter) < BEYOND


def _drawn(sighting: Sighting, fitter: Fitter) -> list[Matrix]:
    """Returns the poses of triples of features, drawn alike at every call."""
    n, poses = len(sighting.pixels), list[Matrix]()
    rng = np.random.default_rng(n)
    for _ in range(SAMPLES if n >= 4 else 0):
        chosen = rng.choice(n, 3, replace=False)
        points, pixels = sighting.points_world[chosen], sighting.pixels[chosen]
        if min(np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)) < APART:
            continue
        _, turns, shifts = cv2.solveP3P(points, pixels, fitter.camera.K_color, None, flags=cv2.SOLVEPNP_AP3P)
        for turn, shift in zip(turns, shifts, strict=True):
            T_color_world = np.eye(4)
            T_color_world[:3, :3], T_color_world[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            poses.append(invert(T_color_world) @ fitter.camera.T_color_depth)
    return [T for T in poses if np.isfinite(T).all()]


def _squared(T_world_camera: Matrix, sighting: Sighting, seen: Points, fitter: Fitter) -> Array:
    """Returns by how many squared sigmas (N,) features are off a pose, by their pixels and their depths together."""
    points = transform_points(invert(T_world_camera), sighting.points_world)
    color = transform_points(fitter.camera.T_color_depth, points)
    ahead = color[:, 2] > 0.05
    off = project(np.where(ahead[:, None], color, 1.0), fitter.camera.K_color) - sighting.pixels
    sigma = np.sqrt(2.0) * fitter.noise.depth * fitter.config.depth_noise.sigma(seen[:, 2])
    squared = np.einsum("ij,ij->i", off, off) / _pixel(fitter) ** 2 + ((points[:, 2] - seen[:, 2]) / sigma) ** 2
    return np.where(ahead, squared, np.inf)


def _term(sighting: Sighting, fitter: Fitter) -> PixelTerm:
    camera = fitter.camera
    return PixelTerm(
        sighting.points_world, sighting.pixels, camera.K_color, camera.T_color_depth, _pixel(fitter), strength=1.0
    )


def _pixel(fitter: Fitter) -> float:
    return max(fitter.noise.pixel, PIXEL)
