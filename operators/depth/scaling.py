"""Metric scale of relative depth: inverse depth = scale * nearness + shift, fitted to pixels of known depth.

Ranftl et al., "Towards robust monocular depth estimation: mixing datasets for zero-shot cross-dataset transfer", 2020,
align so; the fit here is by RANSAC (Fischler and Bolles, 1981), then least squares on what agrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

_SAMPLES = 100


@dataclass(frozen=True)
class Scaling:
    """Inverse depth, 1/m, is `scale` * nearness + `shift`; so many of the given pixels agree with it."""

    scale: float
    shift: float
    given: int
    agreeing: int

    def depth(self, nearness: NDArray[np.float32], farthest: float) -> NDArray[np.float32]:
        """Returns metres, 0 where the inverse depth is below that of the farthest, or nearness is not finite."""
        inverse = self.scale * np.where(np.isfinite(nearness), nearness, -np.inf) + self.shift
        seen = inverse >= 1 / farthest
        return np.where(seen, 1 / np.where(seen, inverse, 1), 0).astype(np.float32)


def fitted(
    nearness: Values, depth: Values, tolerance: float, rng: np.random.Generator, *, shifted: bool
) -> Scaling | None:
    """Fits nearness (N,) to depths (N,), metres, of the same pixels; None where no scale above 0 fits any of them.

    A pixel agrees when its inverse depth is off by less than `tolerance` times itself. Without `shifted` the shift is
    0.
    """
    inverse = 1 / depth
    candidates = _candidates(nearness, inverse, rng, shifted)
    if not len(candidates):
        return None
    off = np.abs(candidates[:, :1] * nearness + candidates[:, 1:] - inverse) < tolerance * inverse
    agrees = off[int(off.sum(axis=1).argmax())]
    for _ in range(3):
        if agrees.sum() < 2:
            return None
        x, y, weight = nearness[agrees], inverse[agrees], depth[agrees]  # errors are shares of the inverse depth
        A = np.column_stack([x, np.ones(len(x))]) if shifted else x[:, None]
        solution = np.linalg.lstsq(A * weight[:, None], y * weight, rcond=None)[0]
        scale, shift = float(solution[0]), float(solution[1]) if shifted else 0.0
        agrees = np.abs(scale * nearness + shift - inverse) < tolerance * inverse
    if not scale > 0:
        return None
    return Scaling(scale, shift, len(depth), int(agrees.sum()))


def _candidates(nearness: Values, inverse: Values, rng: np.random.Generator, shifted: bool) -> Values:
    """Returns scales above 0 and shifts (M, 2) through drawn pixels: two each, or one."""
    if shifted:
        a, b = rng.integers(0, len(nearness), (2, _SAMPLES))
        across = nearness[a] - nearness[b]
        a, b = a[across != 0], b[across != 0]
        scale = (inverse[a] - inverse[b]) / (nearness[a] - nearness[b])
        found = np.column_stack([scale, inverse[a] - scale * nearness[a]])
    else:
        a = rng.integers(0, len(nearness), _SAMPLES)
        a = a[nearness[a] > 0]
        found = np.column_stack([inverse[a] / nearness[a], np.zeros(len(a))])
    return np.asarray(found[found[:, 0] > 0])
