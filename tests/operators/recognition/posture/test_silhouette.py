"""Silhouettes: where a body lands in its window, what is nearer and what hides it, and what does not change them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from operators.recognition.posture.silhouette import HALF, LEAST, MIDDLE, SIDE, silhouette

SENSOR, FOOT = np.array([0.0, 0.0, 1.0]), np.array([3.0, 0.0, 0.0])


def wall(x: float, ys: tuple[float, float], zs: tuple[float, float], step: float = 0.02) -> NDArray[np.float64]:
    """Points (P, 3) of an upright rectangle that faces the sensor."""
    y, z = np.meshgrid(np.arange(*ys, step), np.arange(*zs, step))
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)


def made(
    own: NDArray[np.float64], others: NDArray[np.float64] | None = None, foot: NDArray[np.float64] = FOOT
) -> NDArray[np.float32]:
    others = np.zeros((0, 3)) if others is None else others
    mine = np.arange(len(own) + len(others)) < len(own)
    found = silhouette(np.concatenate([own, others]), mine, foot, SENSOR)
    assert found is not None
    return found


def test_a_body_fills_the_cells_that_it_is_seen_in() -> None:
    body, _, _ = made(wall(3.0, (-0.25, 0.25), (0.0, 1.7)))
    rows, columns = np.nonzero(body)
    cell = 2 * HALF / SIDE
    assert abs(HALF - rows.min() * cell + MIDDLE - 1.7) < 2 * cell
    assert abs((columns.max() - columns.min() + 1) * cell - 0.5) < 2 * cell
    assert abs((columns.max() + columns.min() + 1) / 2 - SIDE / 2) <= 1


def test_hand_stretched_to_the_right_appears_right_and_nearer() -> None:
    hand = wall(2.7, (-0.6, -0.4), (1.0, 1.1))  # y points left
    body, near, _ = made(np.concatenate([wall(3.0, (-0.2, 0.2), (0.0, 1.7)), hand]))
    assert body[:, SIDE // 2 + 12 :].any()
    assert not body[:, : SIDE // 2 - 12].any()
    np.testing.assert_allclose(near[:, SIDE // 2 + 12 :][body[:, SIDE // 2 + 12 :] > 0], 0.3 / 0.6, atol=1e-5)


def test_silhouette_distinguishes_front_behind_and_unseen() -> None:
    table = wall(2.0, (-0.6, 0.6), (0.0, 0.7))
    room = wall(5.0, (0.5, 1.5), (0.0, 2.0))
    _, _, others = made(wall(3.0, (-0.2, 0.2), (0.8, 1.7)), np.concatenate([table, room]))
    assert (others[-12:, 28:36] == 1).all()
    assert (others[20:30, 2:12] == -1).any()
    assert (others[:4] == 0).all()


def test_too_little_and_too_near_bodies_give_none() -> None:
    few = wall(3.0, (0.0, 0.1), (1.0, 1.1), step=0.05)
    assert silhouette(few, np.ones(len(few), bool), FOOT, SENSOR) is None
    whole = wall(0.2, (-0.2, 0.2), (0.0, 1.7))
    assert silhouette(whole, np.ones(len(whole), bool), np.array([0.2, 0, 0]), SENSOR) is None


@given(
    turn=st.floats(-np.pi, np.pi),
    x=st.floats(-20, 20),
    y=st.floats(-20, 20),
    z=st.floats(-3, 3),
    seed=st.integers(0, 100),
)
def test_silhouettes_do_not_depend_on_the_frame_nor_on_the_order_of_points(
    turn: float, x: float, y: float, z: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate([wall(3.0, (-0.2, 0.2), (0.0, 1.7), 0.041), wall(2.5, (-0.5, 0.5), (0.0, 0.6), 0.043)])
    own = np.arange(len(points)) < len(wall(3.0, (-0.2, 0.2), (0.0, 1.7), 0.041))
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    order, offset = rng.permutation(len(points)), np.array([x, y, z])
    first = silhouette(points, own, FOOT, SENSOR)
    moved = (points @ R.T + offset)[order]
    second = silhouette(moved, own[order], R @ FOOT + offset, R @ SENSOR + offset)
    assert np.count_nonzero(np.abs(first - second).max(axis=0) > 1e-6) <= 0.05 * SIDE * SIDE  # on the rims of cells
    assert abs(int(first[0].sum()) - int(second[0].sum())) <= 0.1 * first[0].sum()
    assert first[0].sum() >= LEAST
