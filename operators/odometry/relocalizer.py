"""Finds a lost camera's view among remembered keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.geometry.pinhole import Pixels, Points, project, unproject
from operators.odometry.camera import RgbdCamera
from operators.odometry.features import Gray
from operators.odometry.keyframe import Keyframe
from operators.odometry.recognition import describe, match


@dataclass(frozen=True, eq=False)
class Recall:
    """World points (N, 3) of a keyframe and where the view sees them (N, 2); wrong pairs are among them."""

    keyframe: Keyframe
    points_world: Points
    pixels: Pixels


def recalls(gray: Gray, keyframes: Sequence[Keyframe], camera: RgbdCamera, fewest: int) -> list[Recall]:
    """Returns what keyframes have in common with a view, the most first; only those with enough pairs."""
    seen = describe(gray)
    found = []
    for keyframe in keyframes:
        pairs = match(keyframe.description, seen)
        if len(pairs) < fewest:
            continue
        points, known = rough_points(keyframe, pairs[:, 0], camera)
        if np.count_nonzero(known) >= fewest:
            points_world = transform_points(keyframe.T_world_camera, points[known])
            found.append(Recall(keyframe, points_world, seen.pixels[pairs[known, 1]]))
    return sorted(found, key=lambda recall: -len(recall.pixels))


def candidates(near: Sequence[Keyframe], others: Sequence[Keyframe], count: int, turn: int) -> list[Keyframe]:
    """Returns the nearest keyframes and, in turns, some of the others: all are tried within a few frames."""
    rest = [k for k in others if not any(k is n for n in near)]
    take = min(max(count - len(near), 0), len(rest))
    return [*near, *(rest[(turn * take + i) % len(rest)] for i in range(take))]


def rough_points(keyframe: Keyframe, chosen: NDArray[np.int64], camera: RgbdCamera) -> tuple[Points, NDArray[np.bool_]]:
    """Returns points (N, 3) of described pixels, and which are known: many lie on edges, where either depth may do."""
    surface = keyframe.surface
    inverse, (h, w) = surface.inverse_depth, surface.inverse_depth.shape
    rays = unproject(keyframe.description.pixels[chosen], camera.K_color) @ camera.T_depth_color[:3, :3].T
    origin = camera.T_depth_color[:3, 3]
    points, known = origin + 2.0 * rays, np.zeros(len(rays), np.bool_)
    for _ in range(3):
        u, v = np.rint(project(points, surface.K)).astype(np.int64).T
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        seen = inverse[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)]
        known = inside & (seen > 0)
        z = np.where(known, 1.0 / np.where(known, seen, 1.0), points[:, 2]) - origin[2]
        points = origin + rays * (z / rays[:, 2])[:, None]
    return points, known
