"""A room with boxes, seen by a depth camera, a colour camera and a LiDAR by the same rays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dataflow import Played
from dataflow.messages import CameraInfo, DepthImage, Image, PointCloud, Transforms
from dataflow.messages.diagnostics import Level

Array = NDArray[np.float64]
K = np.array([[272.0, 0, 159.5], [0, 272.0, 119.5], [0, 0, 1.0]])
WIDTH, HEIGHT = 320, 240
ROOM = np.array([[-3.0, -2.5, -0.2], [3.2, 2.6, 2.4]])
BOXES = [
    np.array([[1.4, -0.9, -0.2], [1.9, -0.3, 0.6]]),
    np.array([[1.9, 0.3, 0.2], [2.2, 0.9, 1.1]]),
    np.array([[-1.5, 1.0, -0.2], [-1.0, 1.6, 0.8]]),
    np.array([[-0.3, -1.9, 0.0], [0.2, -1.4, 0.9]]),
]
T_BASE_DEPTH = np.eye(4)
T_BASE_DEPTH[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
T_BASE_DEPTH[:3, 3] = [0.1, 0, 0.7]
T_BASE_LIDAR = np.eye(4)
T_BASE_LIDAR[:3, 3] = [0, 0, 0.5]


def hits(origin: Array, directions: Array) -> tuple[Array, NDArray[np.intp]]:
    """Distances (N,) along directions (N, 3), and which wall or box is hit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_walls = np.where(directions > 0, ROOM[1] - origin, ROOM[0] - origin) / directions
        wall = np.argmin(to_walls, axis=1)
        distance = to_walls[np.arange(len(wall)), wall]
        which = wall + 3 * (directions[np.arange(len(wall)), wall] > 0)
        for k, box in enumerate(BOXES):
            a, b = (box[0] - origin) / directions, (box[1] - origin) / directions
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (near < far) & (near > 0) & (near < distance)
            distance, which = np.where(hit, near, distance), np.where(hit, 6 + k, which)
    return distance, which


def extrinsics(**turned: tuple[str, float]) -> Transforms:
    """Where the sensors are said to be; those named are said to be turned about an axis of theirs, degrees."""
    frames = {"depth": T_BASE_DEPTH, "color": np.eye(4), "lidar": T_BASE_LIDAR}
    matrices = []
    for name, T in frames.items():
        axis, angle = turned.get(name, ("z", 0.0))
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
        matrices.append(T @ turn)
    return Transforms(
        stamp=0,
        frames=("base", "depth", "base"),
        child_frames=("depth", "color", "lidar"),
        translations=np.array([T[:3, 3] for T in matrices]),
        rotations=Rotation.from_matrix([T[:3, :3] for T in matrices]).as_quat(),
    )


def views(count: int, scale: float = 1.0, seed: int = 3) -> Iterator[tuple[DepthImage, Image, PointCloud]]:
    """What is seen from places along a curve: depths `scale` times too long, images, scans, every 0.2 s."""
    rng = np.random.default_rng(seed)
    shades = rng.integers(40, 220, 16)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.column_stack([(u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1], np.ones(u.size)])
    azimuths, elevations = np.meshgrid(np.linspace(-3.14, 3.13, 240), np.deg2rad(np.linspace(-20, 21, 11)))
    a, e = azimuths.ravel(), elevations.ravel()
    beams = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    for k in range(count):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", 0.5 * k).as_matrix()
        T[:3, 3] = [0.4 * np.cos(0.3 * k), 0.4 * np.sin(0.3 * k), 0]
        camera, lidar, stamp = T @ T_BASE_DEPTH, T @ T_BASE_LIDAR, k * 200_000_000
        z, seen = hits(camera[:3, 3], rays @ camera[:3, :3].T)
        z = (z * scale + rng.normal(0, 0.003, z.shape)).reshape(HEIGHT, WIDTH).astype(np.float32)
        gray = (shades[seen] + rng.integers(0, 6, seen.shape)).reshape(HEIGHT, WIDTH).astype(np.uint8)
        distance, _ = hits(lidar[:3, 3], beams @ lidar[:3, :3].T)
        points = beams * (distance + rng.normal(0, 0.01, distance.shape))[:, None]
        yield (
            DepthImage(stamp=stamp, frame="depth", data=z),
            Image(stamp=stamp, frame="color", data=np.repeat(gray[..., None], 3, axis=2)),
            PointCloud(stamp=stamp, frame="lidar", points=points.astype(np.float32)),
        )


def info(frame: str) -> CameraInfo:
    return CameraInfo(stamp=0, frame=frame, width=WIDTH, height=HEIGHT, K=K)


def warnings(played: Played) -> list[str]:
    """What is warned of, in order."""
    return [s.messages[0] for s in played["status"] if s.levels[0] == Level.WARN]
