"""Covariances of measurements, from a message or a setting, checked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class UnusableMessage(Exception):
    """Raised for a message that is ignored; the text names the reason."""


def covariance_of(name: str, given: Array | None, sigma: float | None, setting: str) -> Array:
    """Returns the covariance that counts: of the setting, else of the message."""
    if sigma is not None:
        return np.eye(3) * sigma**2
    if given is None:
        raise ValueError(f"{name}: its messages have no covariance, so its {setting} must say how good it is")
    return positive(given)


def white_part(covariance: Array, drift: Sequence[float]) -> Array:
    """Returns the part (3, 3) of a position's covariance that is not its drift, a tenth at least."""
    if not any(drift):
        return covariance
    least = 0.1 * np.diag(covariance)
    change = np.maximum(np.diag(covariance) - np.square(drift), least) - np.diag(covariance)
    return covariance + np.diag(change)


def positive(covariance: Array) -> Array:
    """Returns the covariance, symmetric. Raises UnusableMessage for what is none."""
    if not np.isfinite(covariance).all():
        raise UnusableMessage("covariance not finite")
    symmetric = np.asarray(0.5 * (covariance + covariance.T))
    if float(np.linalg.eigvalsh(symmetric)[0]) <= 0:
        raise UnusableMessage("covariance not positive")
    return symmetric


def check_finite(*values: Array) -> None:
    """Raises UnusableMessage for values that are not finite."""
    if not all(np.isfinite(v).all() for v in values):
        raise UnusableMessage("not finite")
