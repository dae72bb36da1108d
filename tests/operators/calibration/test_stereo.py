"""The place of a camera beside another, against the one that made the views."""

from __future__ import annotations

import numpy as np
import pytest
from made_boards import Lens, turned
from made_views import poses, view

from dataflow.messages import CameraInfo
from operators.calibration.boards import Chessboard, View
from operators.calibration.stereo import Pair, fit_pair, paired, warnings_of
from operators.geometry.stereo import rectified_pair

BOARD = Chessboard(9, 6, 0.025)
LEFT, RIGHT = Lens(), Lens(fx=415.0, fy=418.0, cx=236.0, cy=181.0, bend=(-0.2, 0.05, 0.0, 0.001, 0.0))
WIDE = tuple(Lens(fx=f, fy=f, bend=(-0.03, 0.006, -0.002, 0.0003), fisheye=True) for f in (210.0, 206.0))
T_LEFT_RIGHT = np.eye(4)
T_LEFT_RIGHT[:3, :3], T_LEFT_RIGHT[:3, 3] = turned(0.01, -0.03, 0.02), (0.12, 0.004, -0.003)
MS = 1_000_000


def info(lens: Lens, frame: str) -> CameraInfo:
    return CameraInfo(
        stamp=0,
        frame=frame,
        width=lens.width,
        height=lens.height,
        distortion_model="equidistant" if lens.fisheye else "plumb_bob",
        K=lens.K,
        distortion=np.array(lens.bend),
    )


def views(left: Lens, right: Lens, apart: int = 0, T_left_right: np.ndarray = T_LEFT_RIGHT) -> list[tuple[View, View]]:
    rng = np.random.default_rng(5)
    T_right_left = np.linalg.inv(T_left_right)
    found = []
    for k, T in enumerate(poses(BOARD, 20, rng)):
        T[2, 3] += 0.25
        found.append(
            (view(BOARD, left, T, rng, k * 250 * MS), view(BOARD, right, T_right_left @ T, rng, k * 250 * MS + apart))
        )
    return found


def fitted(left: Lens, right: Lens, **how: int) -> Pair:
    both = views(left, right, **how)
    pairs = paired([a for a, _ in both], [b for _, b in both], 5 * MS)
    return fit_pair(BOARD, pairs, info(left, "left"), info(right, "right"))


@pytest.mark.parametrize("lenses", [(LEFT, RIGHT), WIDE], ids=["plumb_bob", "equidistant"])
def test_the_pair_is_the_one_that_made_its_views(lenses: tuple[Lens, Lens]) -> None:
    pair = fitted(*lenses)

    assert pair.T_left_right[:3, 3] == pytest.approx(T_LEFT_RIGHT[:3, 3], abs=5e-4)
    turn = pair.T_left_right[:3, :3].T @ T_LEFT_RIGHT[:3, :3]
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 0.1
    _, baseline = rectified_pair(pair.left, pair.right)  # as operators take it
    assert baseline == pytest.approx(pair.baseline)
    assert np.sqrt((pair.rows**2).mean()) < 0.25
    assert pair.rms < 0.3
    assert warnings_of(pair) == []


def test_images_that_are_not_of_one_time_are_named() -> None:
    assert any("3.0 ms apart" in text for text in warnings_of(fitted(LEFT, RIGHT, apart=3 * MS)))


def test_views_pair_with_the_nearest_only_and_need_shared_corners() -> None:
    one, other = views(LEFT, RIGHT)[0]
    early, near = (View(s, other.ids, other.pixels, 2.0) for s in (one.stamp - 4 * MS, one.stamp + MS))
    few = View(one.stamp, other.ids[:7], other.pixels[:7], 2.0)

    assert [b.stamp for _, b in paired([one], [early, near], 5 * MS)] == [near.stamp]
    assert paired([one], [View(9 * MS, other.ids, other.pixels, 2.0)], 5 * MS) == []
    assert paired([one], [few], 5 * MS) == []
    assert paired([one], [], 5 * MS) == []


def test_cameras_the_wrong_way_round_are_named() -> None:
    both = views(LEFT, RIGHT)
    with pytest.raises(ValueError, match="not to its right: exchange the streams"):
        fit_pair(BOARD, [(b, a) for a, b in both], info(RIGHT, "right"), info(LEFT, "left"))
    with pytest.raises(ValueError, match="2 views in which both cameras"):
        fit_pair(BOARD, both[:2], info(LEFT, "left"), info(RIGHT, "right"))
