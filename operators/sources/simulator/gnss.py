"""A satellite receiver over the simulated world, whose tangent plane touches the ellipsoid at a given place."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import NavSatFix
from operators.sources.simulator.frames import Array, mounted
from operators.sources.simulator.settings import Gnss
from operators.sources.simulator.trajectory import Trajectory

_A = 6378137.0  # WGS 84
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)


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
        self._gnss = gnss
        self._error = np.random.default_rng([seed, 41]).normal(0, gnss.drift, 3) * [1, 1, 2]

    def measure(self, path: Trajectory, t: float, rng: np.random.Generator, stamp: int, frame: str) -> NavSatFix:
        gnss = self._gnss
        keep = math.exp(-1 / (gnss.rate * gnss.drift_time))
        scale = np.array([1.0, 1.0, 2.0])
        fresh = rng.standard_normal((2, 3)) * scale
        self._error = keep * self._error + math.sqrt(1 - keep**2) * gnss.drift * fresh[0]
        place = (path.at([t]).T_world_base()[0] @ mounted(gnss.mount))[:3, 3]
        enu = place + self._error + gnss.noise * fresh[1] + np.array(gnss.bias)
        latitude, longitude, altitude = geodetic(enu, gnss.latitude, gnss.longitude, gnss.altitude)
        return NavSatFix(
            stamp=stamp,
            frame=frame,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            satellites=int(rng.integers(8, 13)),
            covariance_type="diagonal_known",
            covariance=np.diag((gnss.noise**2 + gnss.drift**2) * scale**2),
        )
