"""Edges of colour images against edges of depth: the shift that makes one lie on the other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered

Array = NDArray[np.float64]
Surface = NDArray[np.float32]

_JUMP = 0.08  # share of the depth by which neighbours on an edge differ
_STEEPEST = 100.0  # grey levels: steeper edges count no more than such
_MARGIN = 0.05  # share by which the better explanation fits better, from which it is stated
_LAYERS = 3
_REACH, _KEEP = 16, 0.9  # working pixels up to which edges are shifted; share kept at every image
_BLUR = 1.0  # working pixels
_HALVES = ("left half", "right half")


@dataclass(frozen=True)
class Shift:
    """Holds where the edges of the depth fit those of the colour image best.

    `x` and `y` in working pixels; `here` is how well they fit unmoved, as a share of that; `peak` how far the best fit
    stands out, in standard deviations of all; `edges` the pixels that it rests on; `part` names that of the image.
    """

    part: str
    x: int
    y: int
    here: float
    peak: float
    edges: float

    def off(self, least: int) -> bool:
        """Returns whether the edges plainly lie `least` pixels or more from where they should."""
        return max(abs(self.x), abs(self.y)) >= least and self.here < 0.7 and self.peak >= 4.5 and self.edges >= 500


@dataclass(frozen=True)
class Correction:
    """Puts the edges of the depth onto those of the image: a displacement, m, or a turn, rad, of the points.

    Both are of points in the image camera's frame: x to the right and y down of `displacement`, and by `turn` the same
    ways as seen from the camera. One of them is zero: the one that explains near and far edges less well, by `margin`,
    a share of how well the other does. `sure` is whether a turned camera and a displaced one can be distinguished so.
    """

    displacement: tuple[float, float]
    turn: tuple[float, float]
    margin: float

    @property
    def sure(self) -> bool:
        return self.margin >= _MARGIN

    def matrix(self, share: float = 1.0) -> Array:
        """Returns the transform (4, 4) of the points, or a share of it."""
        T = np.eye(4)
        T[:2, 3] = share * np.array(self.displacement)
        x, y = share * np.array(self.turn)
        T[:3, :3] = cv2.Rodrigues(np.array([-y, x, 0.0]))[0]
        return T


class EdgeAlignment(Remembered):
    """Adds up, image by image and forgetting, how well the edges fit at every shift up to a reach.

    The two halves of the image are kept apart: a turn about the optical axis moves them against each other. So are near
    edges and far ones: a camera that is turned moves all alike, one that is displaced near ones more. Working
    pixels are of half the resolution. A depth edge is the rim of what stands in front of something, which nearly
    always shows in the colour image; what else shows there is even over many images.
    """

    _sums: Array
    _edges: Array
    _nearness: Array

    def __init__(self) -> None:
        side = 2 * _REACH + 1
        self._sums = np.zeros((_LAYERS, 2, side, side))  # near edges to far ones, in the left half and the right
        self._edges = np.zeros((_LAYERS, 2))
        self._nearness = np.zeros((_LAYERS, 2))  # sums of 1 / distance, and of edges, of near ones to far ones

    def add(self, image: NDArray[np.uint8], K: Array, rims: Array) -> None:
        """Takes an image (H, W[, 3]) with its K, and points (N, 3) of the same time on rims, in its camera's frame."""
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        half = cv2.resize(gray, (gray.shape[1] // 2, gray.shape[0] // 2), interpolation=cv2.INTER_AREA)
        half = half.astype(np.float32)
        slope = cv2.magnitude(cv2.Sobel(half, cv2.CV_32F, 1, 0), cv2.Sobel(half, cv2.CV_32F, 0, 1))
        slope = np.minimum(slope, np.float32(_STEEPEST))
        height, width = half.shape
        r, middle = _REACH, width // 2
        for sums in (self._sums, self._edges, self._nearness):
            sums *= _KEEP
        for layer, own in enumerate(np.array_split(rims[np.argsort(rims[:, 2], kind="stable")], _LAYERS)):
            drawn = _drawn(own, K, half.shape)
            ahead = own[own[:, 2] > 0.1, 2]
            self._nearness[layer] += float((1 / ahead).sum()), len(ahead)
            for k, (left, right) in enumerate(((r, middle), (middle, width - r))):
                template = drawn[r : height - r, left:right]
                fit = cv2.matchTemplate(slope[:, left - r : right + r], template, cv2.TM_CCORR).astype(np.float64)
                self._sums[layer, k] += fit - fit.mean()
                self._edges[layer, k] += float(template.sum())

    def shifts(self) -> list[Shift]:
        """Returns the shift of the whole image and of its halves, of those that have edges."""
        sums, counts = self._sums.sum(axis=0), self._edges.sum(axis=0)
        parts = [("image", sums.sum(axis=0), float(counts.sum()))]
        parts += [(name, s, float(n)) for name, s, n in zip(_HALVES, sums, counts.tolist(), strict=True)]
        return [_best(name, surface, edges) for name, surface, edges in parts if surface.max() > 0]

    def correction(self, K: Array) -> Correction | None:
        """Returns what makes the edges fit a camera with K best; None before there are near edges and far ones."""
        layers = self._sums.sum(axis=1)
        if not (self._nearness[:, 1] > 0).all():
            return None
        nearness = self._nearness[:, 0] / self._nearness[:, 1]
        layers = [cv2.GaussianBlur(layer, (0, 0), _BLUR) for layer in layers]  # else values in between were lower ones
        shifts = np.arange(-_REACH, _REACH + 0.25, 0.5)  # of the near ones, working pixels
        x, y = (each.ravel() for each in np.meshgrid(shifts, shifts))
        turned, displaced = (
            np.sum([_sampled(a, x * far, y * far) for a, far in zip(layers, scales, strict=True)], axis=0)
            for scales in (np.ones(_LAYERS), nearness / nearness[0])
        )
        focal = K[0, 0] / 2
        worse, better = sorted((float(turned.max()), float(displaced.max())))
        margin = 1 - worse / better
        if turned.max() >= displaced.max():
            best = int(np.argmax(turned))
            return Correction((0.0, 0.0), (float(x[best] / focal), float(y[best] / focal)), margin)
        best = int(np.argmax(displaced))
        metres = 1 / (focal * nearness[0])
        return Correction((float(x[best] * metres), float(y[best] * metres)), (0.0, 0.0), margin)


def rims(depth: NDArray[np.float32], K: Array) -> Array:
    """Returns points (N, 3), metres, in the frame of a depth camera (K) on rims: every second pixel beside one much
    farther. Values that are not finite are no returns."""
    z = np.where(np.isfinite(depth[::2, ::2]), depth[::2, ::2], np.float32(0))
    rim = np.zeros(z.shape, np.bool_)
    for here, there in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        a, b = z[here], z[there]
        jump = (a > 0) & (b > 0) & (np.abs(a - b) > np.float32(_JUMP) * np.minimum(a, b))
        rim[here] |= jump & (a < b)
        rim[there] |= jump & (b < a)
    v, u = np.nonzero(rim)
    d = z[v, u].astype(np.float64)
    return np.column_stack([(2 * u - K[0, 2]) / K[0, 0] * d, (2 * v - K[1, 2]) / K[1, 1] * d, d])


def _drawn(points: Array, K: Array, shape: tuple[int, ...]) -> Surface:
    """An image of half the resolution with ones where points are seen."""
    drawn = np.zeros(shape, np.float32)
    ahead = points[points[:, 2] > 0.1]
    u = np.rint((ahead[:, 0] / ahead[:, 2] * K[0, 0] + K[0, 2]) / 2).astype(np.intp)
    v = np.rint((ahead[:, 1] / ahead[:, 2] * K[1, 1] + K[1, 2]) / 2).astype(np.intp)
    inside = (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
    drawn[v[inside], u[inside]] = 1.0
    return drawn


def _sampled(surface: Array, x: Array, y: Array) -> Array:
    """Returns the values of a surface (S, S) at shifts (N,), between its own by interpolation."""
    at = (x + _REACH).astype(np.float32)[None], (y + _REACH).astype(np.float32)[None]
    return np.asarray(cv2.remap(surface.astype(np.float32), *at, cv2.INTER_LINEAR)[0], np.float64)


def _best(part: str, surface: Array, edges: float) -> Shift:
    row, column = divmod(int(np.argmax(surface)), surface.shape[1])
    top = float(surface[row, column])
    here = float(surface[_REACH, _REACH]) / top
    return Shift(part, column - _REACH, row - _REACH, here, top / float(surface.std()), edges)
