"""A satellite receiver over the simulated world, whose tangent plane touches the ellipsoid at a given place."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import NavSatFix
from operators.simulator.sensors.frames import Array, place
from operators.simulator.settings import Gnss
from operators.simulator.stage import Stage

_A = 6378137.0  # WGS 84
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)

_IN_VIEW, _LEAST = 12, 4  # satellites above the horizon, and those that a fix takes
_MASK = 0.17  # radians above the horizon below which satellites are not used
_FAR = 100.0  # metres within which something may hide a satellite


def geodetic(enu: Array, latitude: float, longitude: float, altitude: float) -> tuple[float, float, float]:
    """Latitude, longitude (degrees) and ellipsoidal height (m) of a point east, north, up (m) of a geodetic origin.

    Through earth-centred coordinates; back by Bowring's iteration (1976), exact to nanometres near the surface.
    """
    lat, lon = math.radians(latitude), math.radians(longitude)
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    n = _A / math.sqrt(1 - _E2 * sl * sl)
    origin = np.array([(n + altitude) * cl * co, (n + altitude) * cl * so, (n * (1 - _E2) + altitude) * sl])
    R = np.array([[-so, -sl * co, cl * co], [co, -sl * so, cl * so], [0, cl, sl]])
    x, y, z = origin + R @ np.asarray(enu, np.float64)
    p = math.hypot(x, y)
    b = _A * (1 - _F)
    beta = math.atan2(z * _A, p * b)
    for _ in range(3):
        phi = math.atan2(z + _E2 / (1 - _E2) * b * math.sin(beta) ** 3, p - _E2 * _A * math.cos(beta) ** 3)
        beta = math.atan2((1 - _F) * math.sin(phi), math.cos(phi))
    n = _A / math.sqrt(1 - _E2 * math.sin(phi) ** 2)
    height = p * math.cos(phi) + z * math.sin(phi) - _A * _A / n
    return math.degrees(phi), math.degrees(math.atan2(y, x)), height


class GnssModel:
    """The receiver with its slowly changing error (a first-order Gauss-Markov process): one call a tick, in order."""

    def __init__(self, gnss: Gnss, seed: int) -> None:
        self._error = np.random.default_rng([seed, 41]).normal(0, gnss.drift, 3) * [1, 1, 2]
        rng = np.random.default_rng([seed, 42])
        azimuth = 2 * math.pi * (np.arange(_IN_VIEW) + rng.uniform(0, 1, _IN_VIEW)) / _IN_VIEW
        elevation = np.arcsin(rng.uniform(math.sin(_MASK), 1, _IN_VIEW))
        level = np.cos(elevation)
        self._satellites = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)

    def measure(
        self, stage: Stage, gnss: Gnss, t: float, rng: np.random.Generator, stamp: int, frame: str
    ) -> NavSatFix | None:
        """A fix, or None where too few satellites are in sight."""
        keep = math.exp(-1 / (gnss.rate * gnss.drift_time))
        scale = np.array([1.0, 1.0, 2.0])
        fresh = rng.standard_normal((2, 3)) * scale
        self._error = keep * self._error + math.sqrt(1 - keep**2) * gnss.drift * fresh[0]
        antenna = (stage.T_world_base(t) @ place(gnss))[:3, 3]
        satellites, worse = int(rng.integers(8, 13)), 1.0
        if gnss.sky:
            satellites = int(np.count_nonzero(~stage.at(t).blocked(self._lines_of_sight(antenna))))
            if satellites < _LEAST:
                return None
            worse = math.sqrt(_IN_VIEW / satellites)
        enu = antenna + worse * self._error + worse * gnss.noise * fresh[1] + np.array(gnss.bias)
        latitude, longitude, altitude = geodetic(enu, gnss.latitude, gnss.longitude, gnss.altitude)
        return NavSatFix(
            stamp=stamp,
            frame=frame,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            satellites=satellites,
            covariance_type="diagonal_known",
            covariance=np.diag(worse**2 * (gnss.noise**2 + gnss.drift**2) * scale**2),
        )

    def _lines_of_sight(self, antenna: Array) -> NDArray[np.float32]:
        """Rays (S, 6) from the antenna towards the satellites."""
        rays = np.concatenate([np.broadcast_to(antenna, self._satellites.shape), _FAR * self._satellites], axis=1)
        return rays.astype(np.float32)
