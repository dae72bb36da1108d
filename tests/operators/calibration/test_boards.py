"""Corners of boards in made images, by a projection that is none of OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from made_boards import Lens, picture, pose, seen, texture, turned

from operators.calibration.boards import Board, Charuco, Chessboard
from operators.calibration.camera import BLURRED

LENS = Lens(320, 240, 280.0, 283.0, 164.0, 116.0)
BOARDS = [Chessboard(9, 6, 0.03), Chessboard(6, 9, 0.03), Charuco(7, 5, 0.04, 0.028, "4X4_50")]


def shown(board: Board, x: float, y: float, z: float, far: float = 0.42) -> tuple[np.ndarray, np.ndarray]:
    """An image of the board, and where its corners are."""
    T_camera_board = pose(board, turned(x, y, z), (0.02, -0.01, far))
    return picture(board, texture(board), LENS, T_camera_board), LENS.project(seen(board, T_camera_board))


@pytest.mark.parametrize("board", BOARDS, ids=str)
@pytest.mark.parametrize("roll", [0.1, 1.4, 3.0])
def test_corners_are_where_the_lens_put_them_however_the_board_is_turned(board: Board, roll: float) -> None:
    image, corners = shown(board, 0.2, -0.3, roll)
    view = board.find(7, image)

    assert view is not None
    assert view.stamp == 7
    assert len(view.ids) > 0.7 * len(corners)
    off = np.linalg.norm(view.pixels - corners[view.ids], axis=1)
    assert np.sqrt((off**2).mean()) < 0.25
    assert off.max() < 0.8


@pytest.mark.parametrize("board", BOARDS[:2], ids=str)
@pytest.mark.parametrize("roll", [0.1, 1.4])
def test_corners_of_a_soft_image_are_exact_where_the_outer_squares_are_cut_to_half(board: Board, roll: float) -> None:
    T_camera_board, drawn, margin = pose(board, turned(0.2, -0.3, roll), (0.02, -0.01, 0.42)), texture(board), 120
    drawn[:margin], drawn[-margin:], drawn[:, :margin], drawn[:, -margin:] = 255, 255, 255, 255
    view = board.find(0, cv2.GaussianBlur(picture(board, drawn, LENS, T_camera_board), (0, 0), 1.2))

    assert view is not None
    off = np.linalg.norm(view.pixels - LENS.project(seen(board, T_camera_board))[view.ids], axis=1)
    assert np.sqrt((off**2).mean()) < 0.09
    assert off.max() < 0.3


def test_a_part_of_a_charuco_board_is_enough_and_a_part_of_a_chessboard_is_not() -> None:
    charuco, chessboard = BOARDS[2], BOARDS[0]
    for board, there in ((charuco, True), (chessboard, False)):
        image, _ = shown(board, 0.0, 0.0, 0.0)
        image[:, :140] = 120
        assert (board.find(0, image) is not None) is there


@pytest.mark.parametrize("blur", [(9, 1), (1, 9)])
def test_motion_along_either_axis_counts_as_blur(blur: tuple[int, int]) -> None:
    image, _ = shown(BOARDS[0], 0.1, 0.1, 0.0)
    sharp, blurred = BOARDS[0].find(0, image), BOARDS[0].find(0, cv2.blur(image, blur))

    assert sharp is not None
    assert blurred is not None
    assert sharp.blur < 3 < BLURRED < blurred.blur


def test_an_image_without_a_board_gives_no_view() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (240, 320), np.uint8)
    assert all(board.find(0, noise) is None for board in BOARDS)


@pytest.mark.parametrize(
    ("make", "wrong"),
    [
        (lambda: Chessboard(2, 6, 0.03), "3x3 inner corners at least"),
        (lambda: Chessboard(9, 6, 0.0), "above zero"),
        (lambda: Charuco(7, 5, 0.03, 0.03), "do not fit"),
        (lambda: Charuco(7, 5, 0.03, 0.02, "9X9_9"), "no set '9X9_9'.* 5X5_100"),
        (lambda: Charuco(1, 5, 0.03, 0.02), "3x3 squares at least, got 2x6"),
    ],
)
def test_a_board_that_cannot_be_is_refused(make, wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        make()
