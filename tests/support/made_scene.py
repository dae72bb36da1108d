"""A made scene: boxes on a floor before a wall, as a camera one metre above the floor sees them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dataflow.messages import CameraInfo, Detections2D, PointCloud, Pose, SegmentationMap
from dataflow.messages.geometry import matrix_to_quaternion, quaternion_from_yaw, quaternion_to_matrix

CLASSES = ("box", "mug")
MASKS = (*CLASSES, "floor", "wall")
WIDTH, HEIGHT, FOCAL = 320, 240, 280.0
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x of the robot is ahead, z up

INFO = CameraInfo.from_intrinsics(
    stamp=0, frame="camera", width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=159.5, cy=119.5
)

Solid = tuple[Sequence[float], Sequence[float], float, int]
"""Centre, full size, yaw in the world, and class."""


def camera(stamp: int, position: Sequence[float] = (0, 0, 1.0), yaw: float = 0.0, pitch: float = 0.25) -> Pose:
    """The camera's pose in the world; `pitch` is how far it looks down."""
    c, s = np.cos(pitch), np.sin(pitch)
    down = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    R = quaternion_to_matrix(quaternion_from_yaw(yaw)) @ down @ OPTICAL
    return Pose(
        stamp=stamp, frame="world", child_frame="camera", position=position, orientation=matrix_to_quaternion(R)
    )


def look(
    pose: Pose, solids: Sequence[Solid], *, wall: float = 5.0, noise: float = 0.0, score: float = 0.9
) -> tuple[PointCloud, Detections2D, SegmentationMap]:
    """Casts a ray through every second pixel at the floor, a wall and boxes; detects what shows 20 of them."""
    T = pose.matrix()
    u, v = np.meshgrid(np.arange(0, WIDTH, 2.0), np.arange(0, HEIGHT, 2.0))
    rays = np.stack([(u - 159.5) / FOCAL, (v - 119.5) / FOCAL, np.ones_like(u)], axis=-1).reshape(-1, 3) @ T[:3, :3].T
    origin = T[:3, 3]
    depth = np.full(len(rays), np.inf)
    hit = np.full(len(rays), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        for number, distance in ((-2, -origin[2] / rays[:, 2]), (-3, (wall - origin[0]) / rays[:, 0])):
            nearer = (distance > 0) & (distance < depth)
            depth[nearer], hit[nearer] = distance[nearer], number
        for number, (center, size, yaw, _) in enumerate(solids):
            R = quaternion_to_matrix(quaternion_from_yaw(yaw))
            local, start = rays @ R, R.T @ (origin - np.asarray(center))
            a, b = (-np.array(size) / 2 - start) / local, (np.array(size) / 2 - start) / local
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            nearer = (near <= far) & (near > 0) & (near < depth)
            depth[nearer], hit[nearer] = near[nearer], number
    depth = depth + np.random.default_rng(pose.stamp).normal(0, noise, len(depth)) if noise else depth
    seen = np.isfinite(depth) & (depth < 6)
    points = (rays[seen] * depth[seen, None]) @ T[:3, :3]
    small = np.full(hit.shape, 255, np.uint8)
    boxes, ids = [], []
    for number, (_, _, _, class_id) in enumerate(solids):
        small[hit == number] = class_id
        if (hit == number).sum() >= 20:
            own = hit == number
            boxes.append(
                [u.ravel()[own].min(), v.ravel()[own].min(), u.ravel()[own].max() + 2, v.ravel()[own].max() + 2]
            )
            ids.append(number)
    small[hit == -2], small[hit == -3] = 2, 3
    masks = np.repeat(np.repeat(small.reshape(u.shape), 2, axis=0), 2, axis=1)
    stamp = pose.stamp
    return (
        PointCloud(stamp=stamp, frame="camera", points=points.astype(np.float32)),
        Detections2D(
            stamp=stamp,
            frame="camera",
            width=WIDTH,
            height=HEIGHT,
            class_names=CLASSES,
            boxes=np.array(boxes, np.float32).reshape(-1, 4),
            scores=np.full(len(boxes), score, np.float32),
            class_ids=np.array([solids[k][3] for k in ids], np.int32),
            ids=np.array(ids, np.int64),
        ),
        SegmentationMap(stamp=stamp, frame="camera", class_names=MASKS, void=255, classes=masks),
    )
