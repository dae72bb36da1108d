"""Sightings of known landmarks by range and bearing, or by bearing alone."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import LandmarkSightings
from dataflow.messages.geometry import invert, transform_points
from operators.simulator.sensors.frames import place
from operators.simulator.settings import Landmarks
from operators.simulator.stage import Stage


def sightings(
    stage: Stage, sensor: Landmarks, t: float, rng: np.random.Generator, stamp: int, frame: str
) -> LandmarkSightings:
    """Those landmarks that are within range and field, and that nothing hides."""
    landmarks = stage.world.landmarks
    T_world_sensor = stage.T_world_base(t) @ place(sensor)
    p = transform_points(invert(T_world_sensor), landmarks)
    ranges, bearings = np.linalg.norm(p, axis=1), np.arctan2(p[:, 1], p[:, 0])
    elevations = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))
    origin = np.broadcast_to(T_world_sensor[:3, 3], landmarks.shape)
    toward = (landmarks - origin) * (1 - 0.06 / np.maximum(ranges, 0.1))[:, None]  # they are fixed to walls
    hidden = stage.at(t).blocked(np.concatenate([origin, toward], axis=1).astype(np.float32))
    seen = (ranges <= sensor.max_range) & (np.abs(bearings) <= sensor.field / 2) & ~hidden
    seen &= rng.random(len(landmarks)) >= sensor.missing
    deviation = sensor.range_noise * np.maximum(ranges, 0.1)
    noise = rng.standard_normal((3, len(landmarks)))
    ids = np.where(rng.random(len(landmarks)) < sensor.unknown, -1, np.arange(len(landmarks)))
    angles = sensor.bearing_noise
    covariances = np.zeros((len(landmarks), 3, 3))
    covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 2, 2] = deviation**2, angles**2, angles**2
    bearing = (bearings + angles * noise[1] + math.pi) % (2 * math.pi) - math.pi
    known = slice(0 if sensor.ranges else 1, 3)
    return LandmarkSightings(
        stamp=stamp,
        frame=frame,
        ids=ids[seen],
        ranges=np.maximum(ranges + sensor.bias + deviation * noise[0], 0)[seen] if sensor.ranges else None,
        bearings=bearing[seen],
        elevations=(elevations + angles * noise[2])[seen],
        covariances=covariances[seen][:, known, known],
    )
