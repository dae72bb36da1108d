"""Values that several ROS messages share: times, vectors, orientations, covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.interop.access_tracking import lose
from dataflow.messages.checks import QUATERNION_TOLERANCE

F64 = npt.NDArray[np.float64]


def time_ns(time: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time or Duration."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def vector(value: Any) -> F64:
    """(3,) of a Point or Vector3."""
    return np.array([value.x, value.y, value.z], np.float64)


def orientation(value: Any) -> F64:
    """(4,) unit quaternion (x, y, z, w): one that is not set (all zeros) is the identity, any other is normalised."""
    return unit(np.array([value.x, value.y, value.z, value.w], np.float64))


def unit(quaternion: F64) -> F64:
    """Returns a quaternion of norm 1; one within the tolerance of messages stays as it is."""
    norm = float(np.sqrt((quaternion * quaternion).sum()))
    if norm == 0.0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    return quaternion if abs(norm - 1.0) <= 0.5 * QUATERNION_TOLERANCE else quaternion / norm


def covariance(message: Any, name: str, size: int) -> F64 | None:
    """(size, size) of a field; None where it is not known: all zeros, -1 first (REP 145), or what cannot be, which is
    lost."""
    data = np.asarray(getattr(message, name), np.float64)
    if not data.any() or data[0] == -1:
        return None
    if not np.isfinite(data).all():
        lose(message, f"{name} that is not finite")
        return None
    if (np.diagonal(data.reshape(size, size)) < 0).any():
        lose(message, f"{name} with a negative variance")
        return None
    return data.reshape(size, size)


def variance(message: Any) -> float | None:
    """The variance of a reading; None where it is not known: no field, 0, below, or not finite, which is lost."""
    value = float(getattr(message, "variance", 0.0))
    if not np.isfinite(value):
        lose(message, "variance that is not finite")
    return value if 0 < value < np.inf else None


def known(values: Any) -> F64 | None:
    """The numbers; None where all are zero, which in ROS means unknown, or one is NaN or infinite."""
    data = np.asarray(values, np.float64)
    return data if data.any() and np.isfinite(data).all() else None


def optional(values: Any, dtype: str) -> npt.NDArray[Any] | None:
    """An array; None for one without elements."""
    data = np.asarray(values, dtype)
    return data if data.size else None


def first(message: Any, *names: str) -> Any:
    """The value of the first of some fields that a message has: ROS 1 and 2, and versions of a package, name them
    differently."""
    for name in names:
        if hasattr(message, name):
            return getattr(message, name)
    raise AttributeError(f"{type(message).__name__} has none of the fields {', '.join(names)}")
