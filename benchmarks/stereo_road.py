"""Stereo pairs of a made motorway: what KITTI's rig would see at 30 m/s, with cars that go along."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry import se3
from operators.odometry.stereo.adjustment import StereoRig

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]

WIDTH, HEIGHT = 1241, 376
RIG = StereoRig(np.array([[707.1, 0.0, 601.9], [0.0, 707.1, 183.1], [0.0, 0.0, 1.0]]), 0.537)
STEP = 3.0  # metres a pair
GROUND = 1.65  # metres below the camera
WALLS = ((-9.0, 0.8), (-30.0, 9.0), (7.0, 3.0), (30.0, 9.0))  # x, height: crash barrier, noise barrier, trees
CARS = ((3.4, 18.0, 2.0), (-3.6, 35.0, -3.0), (-7.0, 60.0, 5.0))  # x, first z, m/s faster than the camera
WAVES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # metres; spots of each size


def motorway(seed: int, pairs: int) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]], list[Matrix]]:
    """Returns left and right images (HEIGHT, WIDTH) and T_world_camera (4, 4) of each."""
    rng = np.random.default_rng(seed)
    lattice, across = rng.random((256, 256), np.float32), np.eye(4)
    across[0, 3] = RIG.baseline
    bend, sway = rng.uniform(-4e-4, 4e-4), rng.uniform(0, 6)
    T, truth, left, right = np.eye(4), list[Matrix](), list[NDArray[np.uint8]](), list[NDArray[np.uint8]]()
    for k in range(pairs):
        cars = [(x, T[2, 3] + z + 0.1 * k * faster) for x, z, faster in CARS]
        for images, camera in ((left, T), (right, T @ across)):
            grey = _seen(camera, cars, lattice) + rng.normal(0, 1.5, (HEIGHT, WIDTH))
            images.append(np.clip(grey, 0, 255).astype(np.uint8))
        truth.append(T)
        pitch = 2e-3 * float(np.cos(0.7 * k + sway))
        T = T @ se3.exp(np.array([0.0, 0.0, STEP, pitch, bend * STEP, 0.0]))
    return left, right, truth


def _seen(T_world_camera: Matrix, cars: list[tuple[float, float]], lattice: Array) -> Array:
    """Returns the brightness (HEIGHT, WIDTH) of the nearest surface along every pixel's ray."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    rays = np.stack([(u - RIG.K[0, 2]) / RIG.K[0, 0], (v - RIG.K[1, 2]) / RIG.K[1, 1], np.ones_like(u)], axis=-1)
    d = rays @ T_world_camera[:3, :3].T.astype(np.float32) + 1e-9
    o = T_world_camera[:3, 3].astype(np.float32)
    reach = np.where(d[..., 1] > 0, (GROUND - o[1]) / d[..., 1], np.inf)
    which = np.zeros(reach.shape, np.int32)
    for i, (x, height) in enumerate(WALLS, 1):
        z = (x - o[0]) / d[..., 0]
        y = o[1] + z * d[..., 1]
        hit = (z > 0.5) & (z < reach) & (z < 900) & (y < GROUND) & (y > GROUND - height)
        reach, which = np.where(hit, z, reach), np.where(hit, i, which)
    for i, (x, far) in enumerate(cars, 1 + len(WALLS)):
        z = (far - o[2]) / d[..., 2]
        p = o[:2] + z[..., None] * d[..., :2]
        hit = (z > 0) & (z < reach) & (np.abs(p[..., 0] - x) < 0.9) & (p[..., 1] < 1.4) & (p[..., 1] > 0.1)
        reach, which = np.where(hit, z, reach), np.where(hit, i, which)
    sky = ~(reach < 900)
    z = np.where(sky, 900.0, reach)
    p = o + z[..., None] * d
    wall, car = (which > 0) & (which <= len(WALLS)), which > len(WALLS)
    a = np.where(wall, p[..., 2], p[..., 0]) + 31.7 * which
    b = np.where(wall | car, p[..., 1], p[..., 2])
    a, b = np.where(sky, 900 * d[..., 0], a), np.where(sky, 900 * d[..., 1], b)
    # What a pixel spans: along a surface met at a grazing angle far more than across.
    graze = np.where(wall, np.abs(d[..., 0]), np.where(car | sky, 1.0, np.abs(d[..., 1])))
    span = z / RIG.K[0, 0] / np.maximum(graze, 1e-3)
    grey = np.full(z.shape, 120.0, np.float32)
    for wave in WAVES:
        visible = np.clip(1.5 - 2.0 * span / wave, 0, 1)
        mx, my = (a / wave) % 254, (b / wave) % 254
        spots = cv2.remap(lattice, mx.astype(np.float32), my.astype(np.float32), cv2.INTER_LINEAR)
        grey += 90 * visible * (spots - 0.5)
    return np.asarray(grey, np.float32)
