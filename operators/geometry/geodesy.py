"""Places on the earth in a plane that touches it: WGS 84 to east, north, up."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_A = 6378137.0  # semi-major axis of WGS 84, metres
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)


def earth_centred(latitude: float, longitude: float, altitude: float) -> Array:
    """Returns earth-centred, earth-fixed coordinates (3,) in metres; degrees, and metres above the ellipsoid."""
    lat, lon = math.radians(latitude), math.radians(longitude)
    n = _A / math.sqrt(1 - _E2 * math.sin(lat) ** 2)
    level = (n + altitude) * math.cos(lat)
    return np.array([level * math.cos(lon), level * math.sin(lon), (n * (1 - _E2) + altitude) * math.sin(lat)])


def east_north_up(latitude: float, longitude: float, altitude: float, origin: tuple[float, float, float]) -> Array:
    """Returns metres (3,) east, north and up of an origin (degrees, degrees, metres)."""
    lat, lon = math.radians(origin[0]), math.radians(origin[1])
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    R = np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])
    return np.asarray(R @ (earth_centred(latitude, longitude, altitude) - earth_centred(*origin)))
