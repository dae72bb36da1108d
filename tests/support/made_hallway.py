"""Stereo pairs of a made hallway, from any place in it."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry import se3
from operators.odometry.stereo.adjustment import StereoRig

Gray = NDArray[np.uint8]
Matrix = NDArray[np.float64]

SIZE = (480, 200)
K = np.array([[300.0, 0.0, 239.5], [0.0, 300.0, 99.5], [0.0, 0.0, 1.0]])
RIG = StereoRig(K, 0.5)
HALLWAY = np.array([[-4.0, -2.5, -5.0], [4.0, 1.5, 30.0]])  # opposite corners, metres; y is down


@cache
def texture(seed: int, times: int) -> Gray:
    """Smooth random spots: corners at every scale."""
    rng, side = np.random.default_rng(seed), 1024 * times
    layers = [
        cv2.resize(rng.random((n, n), np.float32), (side, side), interpolation=cv2.INTER_CUBIC)
        for n in (16 * times, 64 * times, 256 * times)
    ]
    return np.clip((sum(layers) / 3.0 - 0.5) * 400 + 128, 0, 255).astype(np.uint8)


def render(T_world_camera: Matrix, seed: int = 4, times: int = 1) -> Gray:
    """The hallway from inside, by casting a ray through every pixel; its walls repeat after 17 times `times` metres."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    d = rays @ T_world_camera[:3, :3].T + 1e-9
    o = T_world_camera[:3, 3]
    reach = np.maximum((HALLWAY[0] - o) / d, (HALLWAY[1] - o) / d)
    axis, z = reach.argmin(axis=-1), reach.min(axis=-1)
    p = o + d * z[..., None]
    across = np.where(axis == 0, p[..., 1], p[..., 0])
    along = np.where(axis == 2, p[..., 1], p[..., 2])
    side = times * (211 * axis + 97 * (np.take_along_axis(d, axis[..., None], -1)[..., 0] > 0))
    last = 1024 * times - 1
    map_x, map_y = (across * 60 + side) % last, (along * 60 + 2 * side) % last
    shown = cv2.remap(texture(seed, times), map_x.astype(np.float32), map_y.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(shown, np.uint8)


def driving(count: int) -> list[Matrix]:
    """T_world_camera of a car that goes ahead 0.4 m a frame and swerves; the first is the identity."""
    s = np.arange(count)
    return [se3.exp(np.array([0.3 * np.sin(0.2 * i), 0.0, 0.4 * i, 0.0, 0.05 * np.sin(0.25 * i), 0.0])) for i in s]


Pair = tuple[Gray, Gray]


def pairs_at(poses: list[Matrix], noise: int = 3, seed: int = 4, times: int = 1) -> list[Pair]:
    """What the rig sees from poses, with noise of one seed, in the hallway that another papers: see `render`."""
    across = np.eye(4)
    across[0, 3] = RIG.baseline
    rng = np.random.default_rng(noise)

    def noisy(gray: Gray) -> Gray:
        return np.clip(gray + rng.normal(0, 1.5, gray.shape), 0, 255).astype(np.uint8)

    return [(noisy(render(T, seed, times)), noisy(render(T @ across, seed, times))) for T in poses]


@cache
def sequence(count: int) -> tuple[list[Pair], list[Matrix]]:
    poses = driving(count)
    return pairs_at(poses), poses
