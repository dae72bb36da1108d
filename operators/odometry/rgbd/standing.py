"""Separates what stands still from what has moved, among features that a recognised view has in common with the map.

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
FEWEST = 4  # features that a pose is fitted to
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
    rest = part(sighting, ~agree)
    other = _body(rest, seen[~agree], fitter)
    still = replace(part(sighting, agree), T_world_camera=T)
    if other is None or _count(rest, other[1]) < fewest:
        return still
    return replace(still, contrary=seen[~agree][other[1]])


def doubtful(sighting: Sighting, seen: Points, fitter: Fitter) -> int:
    """Returns how many features its pose has at other depths than the view, or at other pixels."""
    return int(np.count_nonzero(_squared(sighting.T_world_camera[None], sighting, seen, fitter) >= BEYOND))


def part(sighting: Sighting, chosen: NDArray[np.bool_]) -> Sighting:
    """Returns a sighting of some of its features (N,) alone."""
    return replace(
        sighting, points_world=sighting.points_world[chosen], pixels=sighting.pixels[chosen], ages=sighting.ages[chosen]
    )


def _count(sighting: Sighting, chosen: NDArray[np.bool_]) -> int:
    """Returns how many different features are chosen; one may have come with several keyframes."""
    return len(np.unique(sighting.pixels[chosen], axis=0))


def _body(sighting: Sighting, seen: Points, fitter: Fitter) -> tuple[Matrix, NDArray[np.bool_]] | None:
    """Returns the pose on which the most surface agrees, and which features (N,) do."""
    poses = _drawn(sighting, fitter)
    if not len(poses):
        return None
    best = poses[np.argsort(_cost(poses, sighting, seen, fitter), kind="stable")[:BEST]]
    for _ in range(ROUNDS):
        agree = _squared(best, sighting, seen, fitter) < BEYOND
        best = np.stack([_fitted(T, part(sighting, on), fitter) for T, on in zip(best, agree, strict=True)])
    T = best[int(np.argmin(_cost(best, sighting, seen, fitter)))]
    return T, _squared(T[None], sighting, seen, fitter)[0] < BEYOND


def _drawn(sighting: Sighting, fitter: Fitter) -> Array:
    """Returns the poses (M, 4, 4) of triples of features, drawn alike at every call."""
    n, poses = len(sighting.pixels), list[Matrix]()
    rng = np.random.default_rng(n)
    for _ in range(SAMPLES if n >= FEWEST else 0):
        chosen = rng.choice(n, 3, replace=False)
        points, pixels = sighting.points_world[chosen], sighting.pixels[chosen]
        if np.square(pixels - pixels[[1, 2, 0]]).sum(axis=1).min() < APART**2:
            continue
        _, turns, shifts = cv2.solveP3P(points, pixels, fitter.camera.K_color, None, flags=cv2.SOLVEPNP_AP3P)
        for turn, shift in zip(turns, shifts, strict=True):
            T_color_world = np.eye(4)
            T_color_world[:3, :3], T_color_world[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            poses.append(invert(T_color_world) @ fitter.camera.T_color_depth)
    found = np.array(poses).reshape(-1, 4, 4)
    return found[np.isfinite(found).all(axis=(1, 2))]


def _fitted(T_world_camera: Matrix, sighting: Sighting, fitter: Fitter) -> Matrix:
    """Returns a pose fitted to the pixels of all features, if these are enough."""
    if len(sighting.pixels) < FEWEST:
        return T_world_camera
    return align(T_world_camera, [_term(sighting, fitter)], PriorTerm(T_world_camera, WEAK), 5).T_world_camera


def _cost(poses: Array, sighting: Sighting, seen: Points, fitter: Fitter) -> Array:
    """Returns what poses (M, 4, 4) leave unexplained (M,): each feature stands for a surface, by its depth squared."""
    return np.asarray(np.minimum(_squared(poses, sighting, seen, fitter), BEYOND) @ seen[:, 2] ** 2, np.float64)


def _squared(poses: Array, sighting: Sighting, seen: Points, fitter: Fitter) -> Array:
    """Returns by how many squared sigmas (M, N) features are off poses (M, 4, 4), by pixels and depths together."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    points = np.einsum("mji,mnj->mni", R, sighting.points_world - t[:, None])
    color = transform_points(fitter.camera.T_color_depth, points.reshape(-1, 3))
    ahead = color[:, 2] > 0.05
    pixels = project(np.where(ahead[:, None], color, 1.0), fitter.camera.K_color).reshape(len(poses), -1, 2)
    off = pixels - sighting.pixels
    sigma = np.sqrt(2.0) * fitter.noise.depth * fitter.config.depth_noise.sigma(seen[:, 2])
    squared = np.square(off).sum(axis=2) / _pixel(fitter) ** 2 + ((points[:, :, 2] - seen[:, 2]) / sigma) ** 2
    return np.where(ahead.reshape(squared.shape), squared, np.inf)


def _term(sighting: Sighting, fitter: Fitter) -> PixelTerm:
    camera = fitter.camera
    return PixelTerm(
        sighting.points_world, sighting.pixels, camera.K_color, camera.T_color_depth, _pixel(fitter), strength=1.0
    )


def _pixel(fitter: Fitter) -> float:
    return max(fitter.noise.pixel, PIXEL)
