"""Colours that stay the same: for a class by its name, for an identity by its number, for a value by its size."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import xxhash

RGB = tuple[int, int, int]
Colors = npt.NDArray[np.uint8]

TRUTH: RGB = (80, 200, 120)
"""Ground truth, wherever it is drawn."""

AGENT: RGB = (255, 120, 60)
"""Agents, whatever else there is."""

NEUTRAL: RGB = (150, 155, 165)
"""Colour of things without class and identity."""

AXES: tuple[RGB, RGB, RGB] = ((235, 80, 80), (90, 200, 90), (90, 140, 250))
"""x, y and z."""

ESTIMATES: tuple[RGB, ...] = ((255, 176, 0), (86, 180, 233), (230, 110, 190), (213, 94, 0), (170, 140, 255))
"""Trajectories that are no ground truth, in the order of their stream names (after Okabe and Ito)."""

_GOLDEN = 0.618033988749895
_LEGIBLE = 0.3
"""Relative luminance (WCAG 2) of a colour that stands out from dark grey by 4.5 to 1 and more."""
_LIGHTNESSES = (0.55, 0.6, 0.65, 0.7, 0.75, 0.8)
_TURBO = ((48, 18, 59), (70, 107, 227), (40, 187, 235), (50, 242, 152), (164, 252, 60), (238, 207, 58), (251, 126, 33),
          (208, 48, 5), (122, 4, 3))  # fmt: skip


def of_class(name: str) -> RGB:
    """The colour of a class: by its name, so that two detectors with different tables agree."""
    return _vivid((xxhash.xxh32_intdigest(name.encode()) % 4096) / 4096)


def of_classes(names: Sequence[str]) -> Colors:
    """Colours (N, 3) of N class names."""
    return np.array([of_class(name) for name in names], np.uint8).reshape(-1, 3)


def of_identity(number: int) -> RGB:
    """The colour of a track, a cluster or an instance: neighbouring numbers get hues far apart."""
    return _vivid((number * _GOLDEN) % 1.0)


def of_identities(numbers: Sequence[int]) -> Colors:
    """Colours (N, 3) of N identities."""
    return np.array([of_identity(number) for number in numbers], np.uint8).reshape(-1, 3)


def of_values(values: npt.ArrayLike, low: float | None = None, high: float | None = None, shades: int = 0) -> Colors:
    """Colours (N, 3) of N numbers from dark blue (low) over green to red (high), after Google's Turbo.

    The limits default to the 2nd and 98th percentile; NaN is neutral grey. `shades`: how many colours there are, 2 or
    more; 0: as many as there are values.
    """
    v = np.asarray(values, np.float64).reshape(-1)
    known = np.isfinite(v)
    colors = np.empty((len(v), 3), np.uint8)
    colors[:] = NEUTRAL
    if known.any():
        lower = float(np.percentile(v[known], 2)) if low is None else low
        upper = float(np.percentile(v[known], 98)) if high is None else high
        t = np.clip((v[known] - lower) / max(upper - lower, 1e-9), 0.0, 1.0)
        if shades:
            t = np.rint(t * (shades - 1)) / (shades - 1)
        stops, ramp = np.linspace(0, 1, len(_TURBO)), np.array(_TURBO, np.float64)
        colors[known] = np.stack([np.interp(t, stops, ramp[:, c]) for c in range(3)], axis=-1).round()
    return colors


def _vivid(hue: float) -> RGB:
    """A colour whose text can be read on the viewer's dark ground: blue and violet are lightened until it can."""
    for lightness in _LIGHTNESSES:
        r, g, b = colorsys.hls_to_rgb(hue, lightness, 0.78)
        if 0.2126 * r**2.2 + 0.7152 * g**2.2 + 0.0722 * b**2.2 >= _LEGIBLE:
            break
    return round(r * 255), round(g * 255), round(b * 255)
