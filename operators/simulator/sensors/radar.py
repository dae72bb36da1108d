"""An automotive-style radar: a fan of cells that report range, bearing and Doppler velocity of what they hit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import RadarScan
from dataflow.messages.geometry import invert, transform_points
from operators.simulator.sensors.frames import Array, place
from operators.simulator.settings import Radar
from operators.simulator.stage import Stage

_CELLS, _LAYERS = 64, 3
_SPAN = 0.12  # elevation of the outer layers, radians
_STEP = 1e-3  # seconds; for the velocities of movers


def scan(stage: Stage, radar: Radar, t: float, rng: np.random.Generator, stamp: int, frame: str) -> RadarScan:
    """One cycle: per cell the nearest reflector, strong ones (metal, upright, near) detected more often."""
    azimuth = (np.arange(_CELLS) + 0.5) / _CELLS * radar.field - radar.field / 2
    elevation = np.linspace(-_SPAN, _SPAN, _LAYERS)
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    beams = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=1)
    T = stage.T_world_base(t) @ place(radar)
    rays = np.concatenate([np.broadcast_to(T[:3, 3], beams.shape), beams @ T[:3, :3].T], axis=1).astype(np.float32)
    hits = stage.at(t).cast(rays)
    distance = hits.distance.reshape(_CELLS, _LAYERS)
    layer = distance.argmin(axis=1)
    cell = np.arange(_CELLS)
    nearest = cell * _LAYERS + layer
    r = hits.distance[nearest].astype(np.float64)
    cosine = np.abs((hits.normals[nearest] * rays[nearest, 3:]).sum(axis=1))
    likely = radar.detection * np.clip(0.35 + 0.65 * cosine, 0, 1)
    seen = np.isfinite(r) & (r < radar.max_range) & (rng.random(_CELLS) < likely)
    reach = np.where(np.isfinite(r), r, 0.0)
    points = np.asarray(rays[nearest, :3] + rays[nearest, 3:] * reach[:, None], np.float64)
    velocity = _relative_velocity(stage, radar, t, points, hits.things[nearest])
    radial = (velocity * rays[nearest, 3:]).sum(axis=1)
    ranges = r[seen] + radar.bias + rng.normal(0, radar.range_noise, seen.sum())
    azimuths = azimuth[seen] + rng.normal(0, radar.azimuth_noise, seen.sum())
    doppler = radial[seen] + rng.normal(0, radar.velocity_noise, seen.sum())
    strength = -8 + 14 * cosine[seen] + rng.normal(0, 2, seen.sum())
    false = int(rng.poisson(radar.clutter))
    ranges = np.concatenate([ranges, rng.uniform(0.5, radar.max_range, false)])
    azimuths = np.concatenate([azimuths, rng.uniform(-0.5, 0.5, false) * radar.field])
    doppler = np.concatenate([doppler, rng.normal(0, 1, false)])
    strength = np.concatenate([strength, rng.normal(-12, 2, false)])
    return RadarScan(
        stamp=stamp,
        frame=frame,
        ranges=np.maximum(ranges, 0).astype(np.float32),
        azimuths=azimuths.astype(np.float32),
        velocities=doppler.astype(np.float32),
        cross_sections=strength.astype(np.float32),
        snr=(strength + 30 - 20 * np.log10(np.maximum(ranges, 0.5))).astype(np.float32),
    )


def _relative_velocity(stage: Stage, radar: Radar, t: float, points: Array, things: NDArray[np.int32]) -> Array:
    """Velocity (N, 3) of the points hit, relative to the antenna, in the world."""
    antenna = stage.drive.state(t).velocity_of(place(radar)[:3, 3])
    velocity = np.tile(-antenna, (len(points), 1))
    for k in np.unique(things):
        if k >= 0 and not stage.world.things[k].still:
            mover = stage.world.things[k].mover
            own = transform_points(invert(mover.frame(t)), points[things == k])
            ends = [transform_points(mover.frame(t + dt), own) for dt in (-_STEP, _STEP)]
            velocity[things == k] += (ends[1] - ends[0]) / (2 * _STEP)
    return velocity
