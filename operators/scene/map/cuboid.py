"""Upright boxes that agree with the image boxes of several views, with points on them, and with usual sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.estimation.kernels import huber
from operators.labels import SizePrior

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Box = tuple[Array, Array, float]
"""Centre (3,), full size (3,) and heading about the vertical of an upright box."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_AROUND = np.radians(22.5 + 45 * np.arange(8))
ELLIPSE = np.array([[0.52 * np.cos(a), 0.52 * np.sin(a), z] for a in _AROUND for z in (-0.5, 0.5)])
_NEAREST = 0.1  # metres before the camera from which a corner has a place in the image
_STEPS = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05, 0.02])  # of centre, m; of log sizes; of heading, rad
_PROBES = np.concatenate([np.zeros((1, 7)), np.diag(_STEPS)])
_PIXELS, _SHARE = 1.5, 0.06  # an edge of an image box strays so much, and by such a share of the box
_CALIBRATED = np.radians(0.3)  # and by such an angle, since cameras are not calibrated better
_INSIDE = 0.02  # metres by which points stray from a box that they are of
_TAIL = 0.8  # standard deviations of noise by which the outermost of accumulated points are beyond a side
_TAIL_FLAT, _TAIL_ROUND = 1.4, 0.8  # and those of single views, on flat sides and on round ones, which recede
_STRAYING, _STRAYING_RAW = 1 / 40, 1 / 10  # of points on each side are others' at most, and of those of single views
_ASKEW = 8.0  # cost of lying otherwise than most things around
_TURN, _TURN_ALONG = 0.1, 0.03  # radians by which the heading that points show strays, and that of a room
_BOUND = 2.0  # standard deviations beyond which a residual's influence grows no more
_SIZES = 4  # residuals, the last ones, that compare heading and sizes with what is known
_ALIKE = 6  # views that tell as much as more do, since their errors are alike
_ROUNDS, _CHOICE = 5, 2  # steps, and after how many the two best ways go on alone


@dataclass(frozen=True, eq=False)
class ImageView:
    """One view of an object: `P` (3, 4) maps the world to pixels; `box` (4,) is the object's in the image.

    `edges` (4,) are those of the box, left, upper, right, lower, that are the object's and not the image's; `eye` (3,)
    is where the camera was at `stamp` (ns). `points` (N, 3) are some of those that the view shows of it.
    """

    P: Array
    box: Array
    edges: NDArray[np.bool_]
    eye: Array
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    stamp: int = 0

    def moved(self, T: Array) -> ImageView:
        """Returns the view after a rigid motion (4, 4) of the camera and what it shows."""
        R, t = T[:3, :3], T[:3, 3]
        return replace(self, P=self.P @ invert(T), eye=R @ self.eye + t, points=self.points @ R.T + t)


@dataclass(frozen=True, eq=False)
class _Ways:
    """Ways (A,) in which a thing may stand: boxes (A, 7), centre, log sizes and heading, and what is expected of each.

    Those whose number in `forms` is below the number of usual forms lie along the points, the others along the room.
    `headings` with `turns` and `logs` with `spreads` are the expected headings and log sizes with their spreads,
    `askew` is the cost of lying otherwise than most things around.
    """

    x: Array
    forms: NDArray[np.intp]
    headings: Array
    turns: Array
    logs: Array
    spreads: Array
    askew: Array

    @classmethod
    def of(
        cls,
        start: Box,
        points: Array,
        eyes: Array,
        usual: Sequence[SizePrior],
        before: tuple[int, Box] | None,
        heading: float | None,
    ) -> _Ways:
        """Returns the ways to try, or that of a settled result; arguments as of `fit_cuboid`, `eyes` (V, 3)."""
        logs, spreads, along = _priors(tuple(usual))
        count = len(logs)
        if before is None:
            x, forms = _starts(start, eyes, logs), np.arange(count)
            if heading is not None:
                turned = _nearest_turn(start[2], heading)
                x = np.concatenate([x, _starts(_along(points, turned), eyes, logs)])
                forms = np.concatenate([forms[~along], forms + count])
                x = x[forms]
            headings = x[:, 6].copy()
        else:
            form, box = before
            form += count if heading is not None and form < count and along[form] else 0  # settled before it was known
            forms, x = np.array([form]), np.array([[*box[0], *np.log(box[1]), box[2]]])
            towards = heading if heading is not None and form >= count else start[2]
            headings = np.array([_nearest_turn(box[2], towards)])
        own = forms % count
        turns = np.where(along[own] & (forms >= count), _TURN_ALONG, _TURN)
        askew = np.where((forms < count) & (heading is not None), _ASKEW, 0.0)
        return cls(x, forms, headings, turns, logs[own], spreads[own], askew)

    def chosen(self, rows: NDArray[np.intp]) -> _Ways:
        return _Ways(*(getattr(self, each.name)[rows] for each in fields(self)))


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Evidence for a box: the image boxes (V, 4) of views `P` (3, V, 4) with their weights, and points.

    `places` (3, N) are `count` points, then the eyes; `cut`, `noise` and `inset` as `_surface` takes them.
    """

    P: Array
    boxes: Array
    weights: Array
    outline: Array
    places: Array
    count: int
    cut: int
    noise: float
    inset: float

    def residuals(self, rows: Array, ways: _Ways) -> Array:
        """Returns the residuals (A, K, R) of boxes (A, K, 7), some for each way."""
        flat = rows.reshape(-1, 7)
        image = images(flat, self.P, self.outline) - self.boxes
        image = (image * self.weights).reshape(len(flat), -1)
        image[np.isnan(image)] = 0.0
        turn = ((rows[..., 6] - ways.headings[:, None]) / ways.turns[:, None]).reshape(-1, 1)
        size = ((rows[..., 3:6] - ways.logs[:, None]) / ways.spreads[:, None]).reshape(-1, 3)
        surface = _surface(flat, self.places, self.count, self.cut, self.noise, self.inset)
        return np.concatenate([image, surface, turn, size], axis=1).reshape(*rows.shape[:2], -1)


def fit_cuboid(
    start: Box,
    views: Sequence[ImageView],
    points: Array,
    usual: Sequence[SizePrior],
    before: tuple[int, Box] | None = None,
    heading: float | None = None,
    noise: float = 0.0,
    *,
    raw: bool = False,
) -> tuple[int, Box, Array]:
    """Returns the upright box that agrees best with image boxes, with points (N, 3) of its surface, and with its class.

    Least squares over centre, sizes and heading, by Gauss and Newton with differences: edges of the box's image against
    those of each view, with a bounded influence, since things hide each other; points at most on the surface, and on it
    where a view sees that side; log sizes as one of the usual ones. `start` is a box around the points. Each way in
    which such things stand is tried, along the heading of `start` and along `heading`, that of most things around,
    what always lies along the room only so; the best is returned with its number; with `before`, an earlier result,
    only that one is tried. Last comes by how many standard deviations each view's edges stray from that box (V,).

    `noise` is that of ranges at one metre, m; it grows by the square. Points are `raw` that are of single views.
    After Nicholson, Milford and Suenderhauf, "QuadricSLAM", 2018, and Yang and Scherer, "CubeSLAM", 2019.
    """
    ways = _Ways.of(start, points, np.stack([v.eye for v in views]), usual, before, heading)
    evidence, edges, alike = _evidence(views, points, usual, noise, raw=raw)
    for turn in range(_ROUNDS if before is None else 2):
        values = evidence.residuals(ways.x[:, None] + _PROBES, ways)
        r, J = values[:, 0], (values[:, 1:] - values[:, :1]) / _STEPS[:, None]
        if turn == _CHOICE and len(ways.x) > 1:
            kept = np.argsort(_cost(r) + ways.askew, kind="stable")[:2]
            ways, r, J = ways.chosen(kept), r[kept], J[kept]
        weighted = J * _influence(r)[:, None]
        A = weighted @ J.transpose(0, 2, 1) + 1e-3 * np.eye(7)
        step = np.linalg.solve(A, -(weighted @ r[..., None]))[..., 0].clip(-20 * _STEPS, 20 * _STEPS)
        ways = replace(ways, x=ways.x + step)
        if (np.abs(step) < 0.1 * _STEPS).all():
            break
    last = evidence.residuals(ways.x[:, None], ways)[:, 0]
    best = int(np.argmin(_cost(last) + ways.askew))
    off = np.abs(last[best, : 4 * len(views)]).reshape(-1, 2, 2).sum(axis=1) * alike
    strays = off.max(axis=1) / np.maximum(edges.reshape(-1, 2, 2).sum(axis=1).max(axis=1), 1)
    x = ways.x[best]
    return int(ways.forms[best]), (x[:3].copy(), np.exp(x[3:6]), float(x[6])), strays


def _evidence(
    views: Sequence[ImageView], points: Array, usual: Sequence[SizePrior], noise: float, *, raw: bool
) -> tuple[_Evidence, Mask, float]:
    """Returns what views and points show of a thing, which edges of the views count (V, 4), and for how many views of
    the same error each one stands, as the square root."""
    outline = ELLIPSE if usual and usual[0].round else CORNERS
    noise *= (_TAIL_ROUND if outline is ELLIPSE else _TAIL_FLAT) if raw else _TAIL
    cut = int(len(points) * (_STRAYING_RAW if raw else _STRAYING))
    P = np.stack([v.P for v in views], axis=1)
    places = np.concatenate([points, np.stack([v.eye for v in views])]).T.copy()
    boxes, edges = np.stack([v.box for v in views]), np.stack([v.edges for v in views])
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    alike = float(np.sqrt(max(1.0, len(views) / _ALIKE)))
    weights = edges / (_stray(P) + _SHARE * sides) / alike
    inset = usual[0].inset if usual else 0.0
    return _Evidence(P, boxes, weights, outline, places, len(points), cut, noise, inset), edges, alike


def _cost(r: Array) -> Array:
    """Returns the cost (A,) of residuals (A, R), after Huber; that of sizes is not bounded."""
    size, strays = np.abs(r), np.arange(r.shape[1]) < r.shape[1] - _SIZES
    bounded = (size >= _BOUND) & strays
    return np.asarray(np.where(bounded, _BOUND * (size - 0.5 * _BOUND), 0.5 * size * size).sum(axis=1))


def _influence(r: Array) -> Array:
    """Returns the weights (A, R) of residuals, after Huber: sizes, the last, do not stray as images and points do."""
    weights = huber(r, _BOUND)
    weights[:, -_SIZES:] = 1.0
    return weights


def _nearest_turn(yaw: float, towards: float) -> float:
    """Returns the heading nearest to `yaw` that is `towards` or turned from it by quarters."""
    return float(yaw + np.remainder(towards - yaw + np.pi / 4, np.pi / 2) - np.pi / 4)


def _along(points: Array, yaw: float) -> Box:
    """Returns the upright box with a heading around points (N, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    local = points @ turn.T
    low, high = local.min(axis=0), local.max(axis=0)
    return (low + high) / 2 @ turn, high - low, yaw


@lru_cache(maxsize=64)  # as many classes
def _priors(usual: tuple[SizePrior, ...]) -> tuple[Array, Array, Mask]:
    """Returns the usual log sizes (A, 3), their spreads, with the sides on the ground either way round, and which of
    them (A,) always lie along the room.
    """
    rows = []
    for each in usual:
        a, b, c = each.size
        rows.append(((a, b, c), each.spread, each.along))
        if b > 1.3 * a:
            turned = (each.spread[1], each.spread[0], each.spread[2])
            rows.append(((b, a, c), turned, each.along))
    if not rows:
        rows.append(((0.3, 0.3, 0.3), (3.0, 3.0, 3.0), False))
    sizes, spreads, along = (np.array(each) for each in zip(*rows, strict=True))
    return np.log(sizes), spreads, along


def _starts(start: Box, eyes: Array, logs: Array) -> Array:
    """Returns the beginnings (A, 7): boxes that are as deep as usual away from the viewers, at `eyes` (V, 3)."""
    center, size, yaw = start
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    along = axes @ (center - eyes.mean(axis=0))[:2]
    deep = int(np.argmax(np.abs(along)))
    sizes = np.tile(np.maximum(size, 0.01), (len(logs), 1))
    lack = np.maximum(np.exp(logs)[:, deep] - sizes[:, deep], 0.0)
    sizes[:, deep] += lack
    rows = np.empty((len(logs), 7))
    rows[:, :3], rows[:, 3:6], rows[:, 6] = center, np.log(sizes), yaw
    rows[:, :2] += axes[deep] * np.sign(along[deep]) * lack[:, None] / 2
    return rows


def _stray(P: Array) -> Array:
    """Returns by how many pixels (V, 1) edges stray in views (3, V, 4), whatever the size of the box."""
    focal = np.linalg.norm(np.cross(P[0, :, :3], P[2, :, :3]), axis=1)  # the third row turns only
    return np.asarray(np.hypot(_PIXELS, _CALIBRATED * focal)[:, None])


def _surface(rows: Array, places: Array, count: int, cut: int, noise: float, inset: float) -> Array:
    """Returns by how much the points' extents differ from the sides of boxes (K, 7): (K, 6), in standard deviations.

    `places` (3, N) are `count` points, then the eyes; `cut` points on each side are left out. Sides that no view sees
    may be farther out than the points.
    """
    c, s = np.cos(rows[:, 6, None]), np.sin(rows[:, 6, None])
    half = np.exp(rows[:, 3:6]) / 2
    x, y = places[0] - rows[:, :1], places[1] - rows[:, 1:2]
    local = np.empty((len(rows), 3, places.shape[1]))
    np.add(c * x, s * y, out=local[:, 0])
    np.subtract(c * y, s * x, out=local[:, 1])
    np.subtract(places[2], rows[:, 2:3], out=local[:, 2])
    low, high = _extents(local[..., :count], cut)
    residual = np.concatenate([low + half, half - high], axis=1)
    eye = local[..., count:]
    eyes = eye.shape[2]
    way = np.abs(eye).sum(axis=2) / eyes
    stray = noise * way * way  # along each axis, by how much of the distance lies along it
    residual[:, :3] += stray
    residual[:, 3:] += stray
    if inset:
        residual -= inset * np.concatenate([half, half], axis=1)
    sides = half[..., None]
    shown = np.concatenate([np.add.reduce(eye < -sides, axis=2), np.add.reduce(eye > sides, axis=2)], axis=1)
    # positive: the side is beyond the points
    return np.asarray(np.where(shown / eyes > 0.3, residual, np.minimum(residual, 0)) / _INSIDE)


def _extents(values: Array, cut: int) -> tuple[Array, Array]:
    """Returns the least and the greatest (K, 3) of values (K, 3, N) without the outermost `cut` on each side."""
    if not cut:
        return values.min(axis=2), values.max(axis=2)
    last = values.shape[2] - 1 - cut
    ranked = np.partition(values, (cut, last), axis=2)
    return ranked[..., cut], ranked[..., last]


def image_boxes(boxes: Array, P: Array, rounded: NDArray[np.bool_]) -> Array:
    """Returns the image boxes (K, 4) of upright boxes (K, 7), centre, sizes and heading, NaN where partly behind.

    `rounded` (K,) marks boxes of objects with a round outline.
    """
    rows = boxes.copy()
    rows[:, 3:6] = np.log(np.maximum(boxes[:, 3:6], 1e-3))
    image = images(rows, P[:, None], CORNERS)[:, 0]
    if rounded.any():
        image[rounded] = images(rows[rounded], P[:, None], ELLIPSE)[:, 0]
    return image


def images(rows: Array, P: Array, outline: Array) -> Array:
    """Returns the image boxes (K, V, 4) of boxes (K, 7) in views (3, V, 4), NaN where partly behind the camera.

    Boxes are centre, log sizes and heading. `outline` (C, 3) are the places in a box of side 1 that are looked at: the
    first axis of what is worked with, along which extremes are found many times as fast.
    """
    c, s = np.cos(rows[:, 6]), np.sin(rows[:, 6])
    x, y, z = outline.T[..., None] * np.exp(rows.T[3:6, None])
    places = np.empty((3, len(outline), len(rows)))
    np.subtract(c * x, s * y, out=places[0])
    np.add(s * x, c * y, out=places[1])
    places[2] = z
    places += rows.T[:3, None]
    seen = places.reshape(3, -1).T @ P[..., :3].reshape(-1, 3).T
    seen += P[..., 3].ravel()
    seen = seen.reshape(len(outline), len(rows), 3, -1)
    depth = np.maximum(seen[:, :, 2], 1e-6)
    uv = seen[:, :, :2] / depth[:, :, None]
    image = np.concatenate([np.minimum.reduce(uv, axis=0), np.maximum.reduce(uv, axis=0)], axis=1).transpose(0, 2, 1)
    image[np.minimum.reduce(depth, axis=0) < _NEAREST] = np.nan
    return image
