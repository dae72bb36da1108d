"""Intrinsics against the lens that made the views; poor data is named."""

from __future__ import annotations

import numpy as np
import pytest
from made_boards import Lens, pose, turned
from made_views import poses, view

from operators.calibration import coverage
from operators.calibration.boards import Chessboard, View
from operators.calibration.camera import CameraCalibration, Model, different, fit_camera, projected, warnings_of

BOARD = Chessboard(9, 6, 0.025)
LENS = Lens()
WIDE = Lens(fx=210.0, fy=212.0, bend=(-0.03, 0.006, -0.002, 0.0003), fisheye=True)


def views_of(lens: Lens, count: int = 30, seed: int = 3, **how: float) -> list[View]:
    rng = np.random.default_rng(seed)
    found = [view(BOARD, lens, T, rng, stamp) for stamp, T in enumerate(poses(BOARD, count, rng, **how))]
    return [v for v in found if len(set(v.ids // 9)) > 2 and len(set(v.ids % 9)) > 2]


def fitted(lens: Lens, views: list[View], model: Model = "plumb_bob") -> CameraCalibration:
    return fit_camera(BOARD, views, "camera", (lens.width, lens.height), model)


@pytest.mark.parametrize(("lens", "model"), [(LENS, "plumb_bob"), (LENS, "rational_polynomial"), (WIDE, "equidistant")])
def test_a_camera_is_the_lens_that_made_its_views(lens: Lens, model: Model) -> None:
    found = fitted(lens, views_of(lens), model)
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7), [1.0]), -1).reshape(-1, 3)

    assert found.info.distortion_model == model
    assert found.rms == pytest.approx(0.1 * np.sqrt(2), rel=0.1)  # the noise of both coordinates
    off = projected(grid, found.info.K, np.array(found.info.distortion), model) - lens.project(grid)
    off -= off.mean(axis=0)  # which the board's pose takes up
    assert np.linalg.norm(off, axis=1).max() < 0.5  # parameters may trade against each other, pixels may not
    if model == "plumb_bob":
        assert found.deviations is not None
        true = np.array([lens.fx, lens.fy, lens.cx, lens.cy])
        got = np.array([found.info.fx, found.info.fy, found.info.cx, found.info.cy])
        assert (np.abs(got - true) < 4 * found.deviations).all()
        assert found.deviations.max() < 2


def test_a_view_that_fits_no_other_is_left_out() -> None:
    views = views_of(LENS)
    wrong = View(99, views[0].ids, views[0].pixels[::-1].copy() * [1.0, 0.8], 2.0)
    found = fitted(LENS, [*views, wrong])

    assert found.left_out == 1
    assert 99 not in [v.stamp for v in found.views]
    assert found.rms < 0.2


def test_views_that_repeat_each_other_and_blurred_ones_count_once_or_not() -> None:
    rng = np.random.default_rng(0)
    T = pose(BOARD, turned(0.3, 0.1, 0), (0, 0, 0.5))
    T_other = pose(BOARD, turned(0.3, 0.1, 0), (0.1, 0, 0.5))
    still = [view(BOARD, LENS, T, rng, stamp) for stamp in range(50)]
    moved = view(BOARD, LENS, T_other, rng, 60)
    smeared = View(70, moved.ids, moved.pixels + 90, 9.0)

    assert [v.stamp for v in different([*still, moved, smeared], LENS.width)] == [0, 60]
    assert len(different(views_of(LENS, 60), LENS.width, most=20)) == 20


@pytest.mark.parametrize(
    ("how", "warning"),
    [
        ({"count": 8}, "views are few"),
        ({"tilt": 0.05}, "0 views show the board tilted by 20° or more"),
        ({"deep": 1.05}, "the board was always 0.3"),
        ({"count": 40}, None),
    ],
)
def test_poor_views_are_named(how: dict[str, float], warning: str | None) -> None:
    found = warnings_of(fitted(LENS, views_of(LENS, **{"count": 30, **how})))

    assert any(warning in text for text in found) if warning else found == []


def test_a_board_that_is_not_flat_shows_as_residual() -> None:
    bulge = 0.02 * np.cos(np.linspace(-1.5, 1.5, 9))[None].repeat(6, axis=0).ravel()  # 2 cm in the middle
    views = []
    for T in poses(BOARD, 30, np.random.default_rng(3)):
        there = np.column_stack([BOARD.points[:, :2], bulge]) @ T[:3, :3].T + T[:3, 3]
        views.append(View(0, np.arange(54), LENS.project(there), 2.0))

    assert any("is the board flat" in text for text in warnings_of(fitted(LENS, views)))


def test_too_few_views_are_an_error() -> None:
    with pytest.raises(ValueError, match="usable views of the board: 3; a calibration takes 4, a good one 12"):
        fitted(LENS, views_of(LENS)[:3])


def test_views_without_tilt_determine_no_focal_length() -> None:
    """OpenCV's deviations of such a fit are small: they leave out the direction that nothing determines."""
    rng = np.random.default_rng(2)
    places = [(x, y, 0.5) for x in (-0.1, -0.05, 0.0) for y in (-0.08, -0.04, 0.0, 0.04)]
    views = [view(BOARD, LENS, pose(BOARD, turned(0, 0, 0.02 * k), at), rng, k) for k, at in enumerate(places)]

    with pytest.raises(ValueError, match=r"do not determine the focal length \(±.* px\): the board must tilt"):
        fitted(LENS, views)


def test_coverage_names_the_parts_without_a_board() -> None:
    left = [View(0, np.arange(4), np.array([[2.0, 2], [155, 2], [155, 355], [2, 355]]), 2.0)]
    seen = coverage.counts(left, (480, 360))

    assert coverage.unseen_parts(seen) == ["top", "top right", "centre", "right", "bottom", "bottom right"]
    assert coverage.in_words(seen).startswith("boards were in 32 % of the image; hardly any top, top right, centre")
    drawn = coverage.picture(seen, left[0].pixels, np.zeros((4, 2)))
    assert drawn.shape == (360, 480, 3)
    assert drawn[100, 60].tolist() == [0, 75, 0]  # green where one was
    assert (drawn[:, 200:, 1] < 50).all()
    assert (drawn[:, 200:, 2] == 200).any()  # red lines elsewhere
    everywhere = [View(0, np.arange(4), np.array([[0.0, 0], [479, 0], [479, 359], [0, 359]]), 2.0)]
    assert coverage.in_words(coverage.counts(everywhere, (480, 360))) == "boards were in 100 % of the image"
