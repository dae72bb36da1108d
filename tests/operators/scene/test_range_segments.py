"""Smooth pieces of what a depth camera sees: things apart from what they stand on and from what is behind them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from operators.scene.lifting import LiftSettings, Seen, lift
from operators.scene.range_segments import range_segments

Array = NDArray[np.float64]

K = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
DOWN = np.radians(30)
UP = np.array([0.0, -np.cos(DOWN), -np.sin(DOWN)])
U, V = (each.ravel().astype(float) for each in np.meshgrid(np.arange(160), np.arange(120)))
RAYS = np.stack([(U - K[0, 2]) / K[0, 0], (V - K[1, 2]) / K[1, 1], np.ones(len(U))], axis=1)


def plane(height: float) -> Array:
    """Returns the depth (N,) of a level plane so far above the camera; infinite where a ray does not meet it."""
    along = RAYS @ UP
    with np.errstate(divide="ignore"):
        return np.where(along * height > 0, height / along, np.inf)


def upright(distance: float, low: float, high: float, half: float, middle: float = 0.0) -> Array:
    """Returns the depth of an upright board across the view, from `low` to `high`, `half` to each side of `middle`."""
    ahead = np.array([0.0, -np.sin(DOWN), np.cos(DOWN)])
    depth = distance / np.maximum(RAYS @ ahead, 1e-9)
    p = RAYS * depth[:, None]
    on = (p @ UP >= low) & (p @ UP <= high) & (np.abs(p[:, 0] - middle) <= half)
    return np.where(on, depth, np.inf)


def view(*depths: Array) -> tuple[Array, NDArray[np.intp]]:
    """Returns the points that are seen of some surfaces, with noise, and which surface each is of."""
    every = np.stack(depths)
    nearest = every.argmin(axis=0)
    depth = every.min(axis=0) + np.random.default_rng(1).normal(0, 0.002, len(U))
    return RAYS * depth[:, None], nearest


def pieces_of(points: Array) -> NDArray[np.int32]:
    pixels = np.stack([U, V], axis=1)
    return range_segments(
        points, pixels, np.isfinite(points).all(axis=1), 0.04 + 0.012 * np.linalg.norm(points, axis=1)
    )


def test_a_thing_on_a_table_is_a_piece_and_so_are_table_and_floor() -> None:
    table = np.where((np.abs((p := RAYS * plane(-0.6)[:, None])[:, 0]) < 0.5) & (p[:, 2] < 1.5), plane(-0.6), np.inf)
    points, surface = view(plane(-1.4), table, upright(1.0, -0.6, -0.35, 0.15))
    pieces = pieces_of(points)
    main = [int(np.bincount(pieces[(surface == k) & (pieces >= 0)]).argmax()) for k in range(3)]
    assert len(set(main)) == 3
    for k, piece in enumerate(main):
        assert (pieces[surface == k] == piece).mean() > 0.8
        assert (surface[pieces == piece] == k).mean() > 0.97


def lifted(points: Array, *boxes: tuple[float, float, float, float]) -> list[NDArray[np.intp]]:
    pixels = np.stack([U, V], axis=1)
    seen = Seen(points, pixels + 0.5, np.isfinite(points).all(axis=1), UP, None, 0.5)
    found = lift(seen, np.array(boxes), [-1] * len(boxes), [], LiftSettings())
    assert [f.detection for f in found] == list(range(len(boxes)))
    return [f.points for f in found]


def around(which: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    return U[which].min(), V[which].min(), U[which].max() + 1, V[which].max() + 1


def test_a_table_keeps_its_top_and_what_stands_on_it_is_lifted_without_it() -> None:
    table = np.where((np.abs((p := RAYS * plane(-0.6)[:, None])[:, 0]) < 0.5) & (p[:, 2] < 1.5), plane(-0.6), np.inf)
    points, surface = view(plane(-1.4), table, upright(1.0, -0.6, -0.4, 0.06))
    top, cup = lifted(points, around(surface == 1), around(surface == 2))
    assert (surface[top] == 1).mean() > 0.97
    assert len(top) > 0.8 * (surface == 1).sum()
    assert (surface[cup] == 2).mean() > 0.95


def test_the_back_of_a_chair_is_not_what_shows_between_its_slats() -> None:
    slats = [upright(1.5, low, low + 0.05, 0.25) for low in (-0.6, -0.5, -0.4, -0.3)]
    points, surface = view(plane(-1.4), upright(2.3, -1.4, 0.5, 2.0), *slats)
    (chair,) = lifted(points, around(surface >= 2))
    assert (surface[chair] >= 2).mean() > 0.95
    assert len(chair) > 0.7 * (surface >= 2).sum()
