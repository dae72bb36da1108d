"""Scans of a LiDAR in made rooms of walls and boxes, with known poses."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3

Array = NDArray[np.float64]

ROOM = np.array([4.0, 3.0, 1.2])  # half extents; the floor is at 0
BOXES = np.array(  # centre and half extents
    [[3.2, 2.2, 0.5, 0.5, 0.3, 0.5], [-3.3, -2.0, 0.9, 0.3, 0.6, 0.9], [0.4, -2.6, 0.35, 0.8, 0.25, 0.35],
     [-2.2, 2.5, 1.0, 0.25, 0.3, 1.0], [0.2, 0.3, 0.6, 0.4, 0.5, 0.6]]
)  # fmt: skip
HALL = np.array([3.0, 4.5, 1.2])
HALL_BOXES = np.array(
    [[1.0, -1.4, 0.4, 0.3, 0.9, 0.4], [-1.5, 1.5, 0.6, 0.4, 0.2, 0.6], [2.0, 3.5, 0.8, 0.9, 0.4, 0.8]]
)
NOTHING = np.zeros((0, 6))


def scan(T: Array, seed: int, room: Array = ROOM, boxes: Array = BOXES, noise: float = 0.01) -> NDArray[np.float32]:
    """What a LiDAR at T (4, 4) in the room sees at one moment, (N, 3) in its own frame."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 180, endpoint=False) + 0.005, np.linspace(-0.4, 0.4, 24)
    )
    own = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    own = own.reshape(-1, 3)
    d = own @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = ((np.sign(d) * room - (T[:3, 3] - [0, 0, room[2]])) / d).min(axis=1)
        for box in boxes:
            one, two = ((box[:3] + s * box[3:] - T[:3, 3]) / d for s in (-1, 1))
            near, far = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
            reach = np.where((near < far) & (near > 0) & (near < reach), near, reach)
    reach += np.random.default_rng(seed).normal(0, noise, len(reach))
    return np.asarray(own * reach[:, None], np.float32)


def at(x: float, y: float, yaw: float) -> Array:
    """A LiDAR 0.7 m above the floor."""
    T = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
    T[:3, 3] = x, y, 0.7
    return T


def on_round(count: int, period: int = 28) -> list[Array]:
    """Poses on a circle of 1.8 m around the box in the middle that closes after `period`."""
    turns = [2 * np.pi * k / period for k in range(count)]
    return [at(1.8 * np.cos(turn), 1.8 * np.sin(turn), turn + np.pi / 2) for turn in turns]


def drifting(truth: list[Array], share: float = 0.03) -> list[Array]:
    """Poses from the first one on, whose every step turns by this share too little."""
    T = [np.eye(4)]
    for one, two in pairwise(truth):
        step = se3.log(invert(one) @ two)
        step[5] *= 1 - share
        T.append(T[-1] @ se3.exp(step))
    return T
