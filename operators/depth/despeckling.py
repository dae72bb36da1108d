"""Wrong pixels of a depth image and what replaces them. Images are (H, W), metres, 0 for no return.

Tests compare inverse depths: on a plane they are linear over the image, whatever its slant, and the noise of a camera
that triangulates is the same at all ranges.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LINES = ((0, 1), (1, 0), (1, 1), (1, -1))


def valid(depth: Depth) -> Mask:
    """Returns which pixels hold a depth: finite and above 0."""
    usable: Mask = np.isfinite(depth) & (depth > 0)
    return usable


def inverse(depth: Depth) -> Depth:
    """Returns 1 / depth, and 0 where there is no return."""
    usable = valid(depth)
    return np.where(usable, 1 / np.where(usable, depth, 1), 0).astype(np.float32)


def flying(depth: Depth, ratio: float) -> Mask:
    """Returns which pixels hang between a nearer and a farther surface, since they saw both.

    On a line through such a pixel, along a row, column or diagonal, one neighbour is nearer and the other farther, each
    by more than `ratio` of the depth, and neither of the surfaces beside it, continued to the pixel, comes that near.
    """
    w = inverse(depth)
    limit = np.float32(ratio) * w
    found = np.zeros(depth.shape, np.bool_)
    for step in _LINES:
        (b2, b1), (a1, a2) = ((_shifted(w, step, k) for k in pair) for pair in ((-2, -1), (1, 2)))
        between = ((w - b1 > limit) & (a1 - w > limit)) | ((b1 - w > limit) & (w - a1 > limit))
        between &= (b1 > 0) & (a1 > 0)
        for near, beyond in ((b1, b2), (a1, a2)):
            continued = np.where(beyond > 0, 2 * near - beyond, near)
            between &= np.abs(continued - w) > limit
        found |= between
    return found & (w > 0)


def outlying(depth: Depth, size: int, ratio: float, deviations: float, support: int) -> Mask:
    """Returns which pixels contradict their surroundings: a window of `size` x `size` pixels.

    Such a pixel is farther from the window's median than `deviations` times the median deviation (scaled to a standard
    deviation) and than `ratio` of the depth, and fewer than `support` of its eight neighbours agree with it: edges and
    thin things have neighbours of the same kind.
    """
    w = inverse(depth)
    limit = np.float32(ratio) * w
    agreeing = np.zeros(depth.shape, np.uint8)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            if dv or du:
                other = _shifted(w, (dv, du), 1)
                agreeing += (other > 0) & (np.abs(other - w) <= limit)
    suspects = np.flatnonzero((agreeing < support) & (w > 0))
    around = _windows(w, suspects, size)
    middle = _median(around)
    own = w.ravel()[suspects]
    spread = _median(np.where(around > 0, np.abs(around - middle[:, None]) + np.float32(1e-9), 0))
    apart = np.abs(own - middle)
    wrong = (middle == 0) | ((apart > deviations * 1.4826 * spread) & (apart > ratio * own))
    found = np.zeros(depth.size, np.bool_)
    found[suspects[wrong]] = True
    return found.reshape(depth.shape)


def replaced(depth: Depth, wrong: Mask, size: int) -> Depth:
    """Returns the image with each wrong pixel replaced by the median of the right ones in its window.

    The median is one of the pixels, never a mean of two, which would fly again. A pixel with no right one around it has
    no return. Pixels without return stay so.
    """
    right = np.where(valid(depth) & ~wrong, depth, 0).astype(np.float32)
    where = np.flatnonzero(wrong)
    out = np.where(valid(depth), depth, 0).astype(np.float32)
    out.ravel()[where] = _median(_windows(right, where, size))
    return out


def median(depth: Depth, size: int) -> Depth:
    """Returns the median of the returns in each window; pixels without return stay so."""
    usable = valid(depth)
    clean = np.where(usable, depth, 0).astype(np.float32)
    whole = cv2.erode(usable.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    out = np.where(whole, cv2.medianBlur(clean, size), 0).astype(np.float32)
    rest = np.flatnonzero(usable & ~whole)
    out.ravel()[rest] = _median(_windows(clean, rest, size))
    return out


def bilateral(depth: Depth, size: int, sigma: float) -> Depth:
    """Returns the image smoothed within surfaces, not over edges: weights fall with the difference of inverse depth.

    `sigma` is in 1/m. Tomasi and Manduchi, "Bilateral filtering for gray and color images", 1998.
    """
    w = inverse(depth)
    smooth = cv2.bilateralFilter(w, size, sigma, size / 2.0)
    return np.where(w > 0, 1 / np.where(w > 0, np.maximum(smooth, 1e-6), 1), 0).astype(np.float32)


def _shifted(image: Depth, step: tuple[int, int], times: int) -> Depth:
    """Returns the pixel `times` steps (rows, columns) away from each; 0 outside the image."""
    dv, du = step[0] * times, step[1] * times
    height, width = image.shape
    out = np.zeros_like(image)
    rows, columns = slice(max(0, -dv), min(height, height - dv)), slice(max(0, -du), min(width, width - du))
    if rows.start < rows.stop and columns.start < columns.stop:
        out[rows, columns] = image[rows.start + dv : rows.stop + dv, columns.start + du : columns.stop + du]
    return out


def _windows(image: Depth, where: NDArray[np.intp], size: int) -> Depth:
    """Returns the windows (M, size²) around flat pixel indices (M,), without the pixel itself; 0 outside the image."""
    half = size // 2
    padded = np.pad(image, half)
    views = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    rows, columns = np.divmod(where, image.shape[1])
    windows = views[rows, columns].reshape(len(where), size * size).copy()
    windows[:, size * size // 2] = 0
    return windows


def _median(windows: Depth) -> Depth:
    """Returns the lower median (M,) of the values above 0 in each row (M, K); 0 where there is none."""
    ordered = np.sort(np.where(windows > 0, windows, np.inf), axis=1)
    counts = (windows > 0).sum(axis=1)
    picked = np.take_along_axis(ordered, np.maximum(counts - 1, 0)[:, None] // 2, axis=1)[:, 0]
    return np.where(counts > 0, picked, 0).astype(np.float32)
