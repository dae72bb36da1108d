"""Images of a made corner of two walls, from any place before it."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry import se3

Gray = NDArray[np.uint8]
Array = NDArray[np.float64]

SIZE = (360, 240)
K = np.array([[260.0, 0.0, 179.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
RATE = 20


@cache
def wall() -> Gray:
    """Smooth random spots: corners at every scale."""
    rng = np.random.default_rng(8)
    layers = [
        cv2.resize(rng.random((n, n), np.float32), (1600, 1600), interpolation=cv2.INTER_CUBIC) for n in (30, 100, 320)
    ]
    return np.clip((sum(layers) / 3.0 - 0.5) * 400 + 128, 0, 255).astype(np.uint8)


def seen_from(T_world_camera: Array) -> Gray:
    """A corner of two walls, z = 3 + |x| / 2."""
    d, t = _cast(T_world_camera, K, SIZE)
    o = T_world_camera[:3, 3]
    X, Y = o[0] + d[..., 0] * t, o[1] + d[..., 1] * t
    rng = np.random.default_rng(abs(int(1e6 * float(o @ [1, 2, 3]))))
    shown = cv2.remap(wall(), (X * 200 + 800).astype(np.float32), (Y * 200 + 800).astype(np.float32), 1)
    return np.clip(shown + rng.normal(0, 1.5, shown.shape), 0, 255).astype(np.uint8)


def depth_from(T_world_camera: Array, K: Array = K, size: tuple[int, int] = SIZE) -> NDArray[np.float32]:
    """The depth of the same corner, metres, by a camera of its own."""
    return _cast(T_world_camera, K, size)[1].astype(np.float32)


def _cast(T_world_camera: Array, K: Array, size: tuple[int, int]) -> tuple[Array, Array]:
    """Returns a ray of depth 1 through every pixel (H, W, 3) in the world, and how many of them reach the walls."""
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    d, o = rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    far = [(3 + s * o[0] / 2 - o[2]) / np.maximum(d[..., 2] - s * d[..., 0] / 2, 0.05) for s in (1, -1)]
    return d, np.where(o[0] + d[..., 0] * far[0] >= 0, far[0], far[1])


def aside(count: int, step: float = 0.03) -> list[Array]:
    """Poses of a camera that goes to the right and sways up and down."""
    s = np.arange(count)
    return [se3.exp(np.array([step * k, 0.1 * np.sin(0.2 * k), 0.05 * np.sin(0.1 * k), 0, -0.004 * k, 0])) for k in s]


@cache
def rendered(count: int) -> tuple[Gray, ...]:
    return tuple(seen_from(T) for T in aside(count))
