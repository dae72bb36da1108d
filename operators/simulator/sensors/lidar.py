"""A rotating laser scanner."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import PointCloud
from operators.simulator.sensors.frames import place
from operators.simulator.settings import Lidar
from operators.simulator.stage import Stage


def sweep(stage: Stage, lidar: Lidar, t: float, rng: np.random.Generator, stamp: int, frame: str) -> PointCloud:
    """One turn that ends at `t`; points in the scanner's frame as it was when each was measured, column after column.

    The robot stands still during the turn unless `lidar.motion`; other movers always do.
    """
    angle = 2 * math.pi * np.arange(lidar.columns) / lidar.columns
    elevation = np.linspace(lidar.lower, lidar.upper, lidar.rings)
    beams = np.stack(
        [
            np.outer(np.cos(angle), np.cos(elevation)),
            np.outer(np.sin(angle), np.cos(elevation)),
            np.broadcast_to(np.sin(elevation), (lidar.columns, lidar.rings)),
        ],
        axis=-1,
    )
    before = (np.arange(lidar.columns) + 1) / lidar.columns - 1  # share of a turn before its end
    offsets = before / lidar.rate if lidar.motion else np.zeros(lidar.columns)
    T = stage.drive.poses(t + offsets) @ place(lidar)
    rays = np.empty((lidar.columns, lidar.rings, 6), np.float32)
    rays[..., :3] = T[:, None, :3, 3]
    rays[..., 3:] = np.einsum("cij,crj->cri", T[:, :3, :3], beams)
    hits = stage.at(t).cast(rays.reshape(-1, 6))
    ranges = hits.distance + lidar.bias + rng.normal(0, lidar.noise, hits.distance.shape)
    cosine = np.abs((hits.normals * rays.reshape(-1, 6)[:, 3:]).sum(axis=1))
    kept = np.isfinite(hits.distance) & (hits.distance >= lidar.min_range) & (hits.distance <= lidar.max_range)
    kept &= rng.random(ranges.shape) >= lidar.missing
    points = beams.reshape(-1, 3)[kept] * ranges[kept, None]
    if lidar.resolution > 0:
        points = np.rint(points / lidar.resolution) * lidar.resolution
    rings = np.tile(np.arange(lidar.rings), lidar.columns)
    return PointCloud(
        stamp=stamp,
        frame=frame,
        points=points.astype(np.float32),
        intensities=np.rint(255 * hits.brightness * np.sqrt(cosine))[kept].astype(np.float32),
        rings=rings[kept].astype(np.uint16),
        time_offsets=np.repeat(offsets, lidar.rings)[kept].astype(np.float32) if lidar.motion else None,
    )
