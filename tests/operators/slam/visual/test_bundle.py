"""Bundle adjustment on made scenes with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.odometry.rgbd.camera import RgbdCamera
from operators.slam.pose_graph import Edge
from operators.slam.visual.bundle import CAUCHY, Bundle, Observations, adjusted
from operators.sources.room import look_at

Array = NDArray[np.float64]

K = np.array([[260.0, 0.0, 159.5], [0.0, 255.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = RgbdCamera(K, K, se3.exp(np.array([0.03, -0.01, 0.02, 0.01, -0.02, 0.015])))
SIGMA_PIXEL, SIGMA_DEPTH = 0.5, 0.01


def scene(seed: int, noise: float = 1.0, views: int = 6, count: int = 80) -> tuple[Array, Array, Observations]:
    """True poses (W, 4, 4) around a heap of points (M, 3), and what each view sees, one in four without depth."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.8, 0.8, (count, 3))
    angles = np.linspace(0.0, 0.8, views)
    poses = np.array([look_at(np.array([2.5 * np.cos(a), 2.5 * np.sin(a), 0.5]), np.zeros(3)) for a in angles])
    seen = [(k, m) for k in range(views) for m in range(count) if rng.random() < 0.8]
    frames, rows = np.array(seen).T
    pixels, depths = np.empty((len(seen), 2)), np.empty(len(seen))
    for i, (k, m) in enumerate(seen):
        p = transform_points(invert(poses[k]), points[m : m + 1])
        pixels[i] = project(transform_points(CAMERA.T_color_depth, p), K)[0]
        depths[i] = p[0, 2]
    pixels += noise * SIGMA_PIXEL * rng.standard_normal(pixels.shape)
    depths += noise * SIGMA_DEPTH * rng.standard_normal(depths.shape)
    depths[rng.random(len(depths)) < 0.25] = np.nan
    observed = Observations(frames, rows, pixels, depths, SIGMA_PIXEL, np.full(len(depths), SIGMA_DEPTH))
    return poses, points, observed


def shaken(poses: Array, points: Array, fixed: int, seed: int = 0) -> tuple[Array, Array]:
    """Poses after the first `fixed` ones off by 3 cm and 0.01 rad, points by 3 cm."""
    rng = np.random.default_rng(seed)
    off = [se3.exp(rng.normal(0, 1, 6) * np.array([0.03] * 3 + [0.01] * 3)) for _ in poses[fixed:]]
    return np.array([*poses[:fixed], *(T @ d for T, d in zip(poses[fixed:], off, strict=True))]), points + rng.normal(
        0, 0.03, points.shape
    )


def chain(poses: Array, seed: int = 0) -> list[Edge]:
    """Motions between neighbours, as an odometry measures them, and a loop."""
    rng = np.random.default_rng(seed)
    sigma = np.array([0.01] * 3 + [0.004] * 3)
    ends = [*((k, k + 1, False) for k in range(len(poses) - 1)), (0, len(poses) - 1, True)]
    return [
        Edge(a, b, invert(poses[a]) @ poses[b] @ se3.exp(rng.normal(0, 1, 6) * sigma), np.diag(sigma**-2), loop)
        for a, b, loop in ends
    ]


def off(found: Bundle, truth: Array) -> Array:
    return np.array([se3.log(invert(T) @ est) for T, est in zip(truth, found.poses, strict=True)])


def cost(poses: Array, points: Array, seen: Observations, edges: list[Edge], strength: float) -> float:
    """What the optimum is the least of, written one sighting and one edge at a time."""
    total = 0.0
    for k, m, pixel, depth in zip(seen.frames, seen.points, seen.pixels, seen.depths, strict=True):
        p = invert(poses[k]) @ np.append(points[m], 1.0)
        q = CAMERA.T_color_depth @ p
        e = (np.array([K[0, 0] * q[0] / q[2] + K[0, 2], K[1, 1] * q[1] / q[2] + K[1, 2]]) - pixel) / SIGMA_PIXEL
        total += 0.5 * strength * CAUCHY**2 * np.log1p(e @ e / CAUCHY**2)
        if np.isfinite(depth):
            total += 0.5 * strength * CAUCHY**2 * np.log1p(((p[2] - depth) / SIGMA_DEPTH) ** 2 / CAUCHY**2)
    for edge in edges:
        e = se3.log(invert(edge.T) @ invert(poses[edge.first]) @ poses[edge.last])
        square = float(e @ edge.information @ e)
        total += 0.5 * (16.0 * square / (16.0 + square) if edge.loop else square)
    return total


@pytest.mark.parametrize("seed", range(3))
def test_exact_sightings_lead_back_to_the_truth(seed: int) -> None:
    poses, points, seen = scene(seed, noise=0.0)
    found = adjusted(CAMERA, *shaken(poses, points, 1), seen, [], 1, 1.0, 20)
    assert np.abs(off(found, poses)).max() < 1e-5
    assert np.abs(found.points - points).max() < 1e-4
    assert found.squared.max() < 1e-3


@pytest.mark.parametrize("strength", [1.0, 0.05])
def test_the_optimum_is_where_the_cost_of_sightings_and_edges_is_least(strength: float) -> None:
    poses, points, seen = scene(3, views=4, count=30)
    edges = chain(poses)
    found = adjusted(CAMERA, *shaken(poses, points, 2), seen, edges, 2, strength, 200)
    least, step = cost(found.poses, found.points, seen, edges, strength), 1e-4
    for k in range(2, 4):
        for i in range(6):
            for sign in (-1, 1):
                moved = found.poses.copy()
                moved[k] = moved[k] @ se3.exp(sign * step * np.eye(6)[i])
                assert cost(moved, found.points, seen, edges, strength) > least
    for m in range(0, 30, 7):
        for sign in (-1, 1):
            shifted = found.points.copy()
            shifted[m, m % 3] += sign * step
            assert cost(found.poses, shifted, seen, edges, strength) > least


def test_noisy_sightings_make_poses_better_than_edges_alone() -> None:
    poses, points, seen = scene(5)
    edges = chain(poses)
    start, spread = shaken(poses, points, 1)
    alone = adjusted(CAMERA, start, spread[:0], _nothing(), edges, 1, 1.0, 20)
    both = adjusted(CAMERA, start, spread, seen, edges, 1, 1.0, 20)
    assert np.abs(off(both, poses)[:, :3]).max() < 0.5 * np.abs(off(alone, poses)[:, :3]).max()


def _nothing() -> Observations:
    none = np.zeros(0, np.int64)
    return Observations(none, none, np.zeros((0, 2)), np.zeros(0), SIGMA_PIXEL, np.zeros(0))


def test_wrong_sightings_are_outvoted_and_have_large_residuals() -> None:
    poses, points, seen = scene(7)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(seen.points)) < 0.1
    pixels = seen.pixels + np.where(wrong[:, None], rng.choice([-1, 1], (len(wrong), 2)) * 20.0, 0.0)
    right = adjusted(CAMERA, *shaken(poses, points, 1), seen, [], 1, 1.0, 40)
    found = adjusted(CAMERA, *shaken(poses, points, 1), replace(seen, pixels=pixels), [], 1, 1.0, 40)
    assert np.abs(off(found, right.poses)[:, :3]).max() < 0.01
    told = found.squared[:, 0] > 25.0
    assert (told == wrong).mean() > 0.97


def test_fixed_poses_stay_and_equal_input_gives_equal_bytes() -> None:
    poses, points, seen = scene(2)
    start, spread = shaken(poses, points, 3)
    one, other = (adjusted(CAMERA, start, spread, seen, chain(poses), 3, 0.2, 5) for _ in range(2))
    assert one.poses[:3].tobytes() == poses[:3].tobytes()
    assert not np.allclose(one.poses[3:], start[3:])
    assert one.poses.tobytes() == other.poses.tobytes()
    assert one.points.tobytes() == other.points.tobytes()


def test_points_behind_the_camera_pull_no_pose() -> None:
    poses, points, seen = scene(4, noise=0.0)
    behind = points.copy()
    behind[0] = 2.0 * poses[0][:3, 3]
    found = adjusted(CAMERA, poses, behind, seen, [], 1, 1.0, 3)
    assert np.isfinite(found.poses).all()
    assert np.abs(off(found, poses)).max() < 1e-3
