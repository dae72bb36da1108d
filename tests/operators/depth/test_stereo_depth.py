"""StereoDepth on pairs whose disparities are known."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from played_twice import counted_twice

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image
from dataflow.testing import Played, play
from operators.depth import StereoDepth
from operators.depth.stereo_matching import MatchingConfig, StereoMatcher

HEIGHT, WIDTH, FOCAL, BASELINE = 96, 160, 100.0, 0.2
SMALL: dict[str, Any] = {"disparities": 32, "speckle": 20}


def texture(seed: int = 0, width: int = 2 * WIDTH) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (HEIGHT, width)).astype(np.uint8)
    return cv2.equalizeHist(cv2.GaussianBlur(noise, (0, 0), 1.2))


def shifted(image: np.ndarray, by: np.ndarray | float) -> np.ndarray:
    """The image (H, WIDTH) whose pixel x shows what `image` has at x + by."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    return cv2.remap(image, (columns + by).astype(np.float32), rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def flat_pair(disparity: float) -> tuple[np.ndarray, np.ndarray]:
    """A wall before both cameras."""
    scene = texture()
    return shifted(scene, 40.0), shifted(scene, 40.0 + disparity)


def step_pair(far: int = 6, near: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A near board before a far wall: left, right, the true disparity, and what only the left camera sees."""
    wall, board = texture(1), texture(2)
    left, right = shifted(wall, 40.0), shifted(wall, 40.0 + far)
    truth = np.full((HEIGHT, WIDTH), float(far))
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    left[20:70, 80:130] = board[20:70, 80:130]
    right[20:70, 80 - near : 130 - near] = board[20:70, 80:130]
    truth[20:70, 80:130] = near
    hidden[20:70, 80 - near + far : 80] = True
    return left, right, truth, hidden


def infos(**changes: Any) -> tuple[CameraInfo, CameraInfo]:
    both = []
    for name, baseline in (("left", 0.0), ("right", BASELINE)):
        info = CameraInfo.from_intrinsics(
            stamp=0, frame=name, width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=79.5, cy=47.5
        )
        P = np.hstack([info.K, np.zeros((3, 1))])
        P[0, 3] = -FOCAL * baseline
        both.append(info.replace(P=P))
    both[1] = both[1].replace(**changes)
    return both[0], both[1]


def measured(left: np.ndarray, right: np.ndarray, calibration: Any = None, **params: Any) -> Played:
    left_info, right_info = calibration or infos()
    return play(
        StereoDepth(**(SMALL | params)),
        {
            "left": [Image(stamp=1, frame="left", data=left)],
            "right": [Image(stamp=1, frame="right", data=right)],
            "left_info": [left_info],
            "right_info": [right_info],
        },
        static=["left_info", "right_info"],
    )


def depth_of(played: Played) -> np.ndarray:
    (depth,) = played["depth"]
    assert isinstance(depth, DepthImage)
    assert depth.frame == "left"
    return depth.data


def status_of(played: Played) -> tuple[str, int, dict[str, int]]:
    (status,) = played["status"]
    assert isinstance(status, Diagnostics)
    return status.messages[0], int(status.levels[0]), {k: int(v) for k, v in status.pairs(0).items()}


@pytest.mark.parametrize("disparity", [5.0, 10.25, 10.5, 18.7])
def test_a_wall_has_its_depth_to_a_fraction_of_a_pixel(disparity: float) -> None:
    depth = depth_of(measured(*flat_pair(disparity)))
    seen = depth > 0
    found = FOCAL * BASELINE / depth[seen]
    assert seen[:, 24:].mean() > 0.97
    assert np.median(found) == pytest.approx(disparity, abs=0.1)
    assert np.percentile(np.abs(found - disparity), 99) < 0.5


def test_pixels_seen_by_one_camera_have_no_depth() -> None:
    left, right, truth, hidden = step_pair()
    played = measured(left, right)
    depth = depth_of(played)
    text, level, counts = status_of(played)
    right_there = np.abs(depth - FOCAL * BASELINE / truth) < 0.05 * FOCAL * BASELINE / truth
    assert (depth[hidden] == 0).mean() > 0.75
    assert right_there[~hidden & (depth > 0)].mean() > 0.97
    assert level == 0
    assert counts["inconsistent"] + counts["unmatched"] > 0.8 * hidden.sum()
    assert counts["pixels"] == sum(n for name, n in counts.items() if name != "pixels")
    assert text == f"{counts['measured']} of {counts['pixels']} pixels measured"


def test_it_sees_more_than_plain_matching_with_the_same_settings_and_errs_less() -> None:
    left, right, truth, _ = step_pair()
    plain = cv2.StereoSGBM.create(
        0, 32, 5, 8 * 25, 32 * 25, disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=5, speckleWindowSize=20,
        speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    ).compute(left, right).astype(np.float64) / 16  # fmt: skip
    ours = StereoMatcher(MatchingConfig(disparities=32, speckle=20)).match(left, right).disparity
    assert np.isfinite(ours).sum() > 1.1 * (plain > 0).sum()  # plain matching leaves out a border of 32 pixels
    wrong = [
        (np.abs(found - truth)[seen] > 1).mean() for found, seen in ((ours, np.isfinite(ours)), (plain, plain > 0))
    ]
    assert wrong[0] <= wrong[1]


def test_colour_and_grey_and_an_offset_give_the_depth_meant() -> None:
    left, right = flat_pair(10.0)
    color = [np.repeat(image[..., None], 3, axis=2) for image in (left, right)]
    np.testing.assert_array_equal(depth_of(measured(*color)), depth_of(measured(left, right)))
    moved = depth_of(measured(left, right, offset=2.0))
    assert np.median(moved[moved > 0]) == pytest.approx(FOCAL * BASELINE / 8.0, rel=0.02)


def test_depths_outside_the_range_are_counted_and_no_returns() -> None:
    played = measured(*flat_pair(10.0), max_range=1.5)
    text, level, counts = status_of(played)
    assert not depth_of(played).any()
    assert (counts["measured"], level) == (0, 1)
    assert counts["out of range"] > 0.8 * counts["pixels"]
    assert text.startswith("0 of ")


@pytest.mark.parametrize(
    ("blank", "text"), [((0,), "the left image"), ((1,), "the right image"), ((0, 1), "the left and the right image")]
)
def test_black_images_are_named(blank: tuple[int, ...], text: str) -> None:
    pair = list(flat_pair(10.0))
    for which in blank:
        pair[which] = np.zeros_like(pair[which])
    played = measured(*pair)
    found, level, counts = status_of(played)
    assert f"no structure in {text}" in found
    assert level == 1
    assert counts["measured"] < 0.05 * counts["pixels"]


def test_images_that_show_different_things_hardly_match() -> None:
    played = measured(texture(1, WIDTH), texture(2, WIDTH), least_share=0.4)
    text, level, _ = status_of(played)
    assert text.endswith("the pair hardly matches")
    assert level == 1


@pytest.mark.parametrize(("by", "text"), [(2, "2.0 px lower"), (-3, "3.0 px higher")])
def test_a_pair_whose_rows_differ_is_named(by: int, text: str) -> None:
    left, right, *_ = step_pair()
    played = measured(left, np.roll(right, by, axis=0))
    found, level, counts = status_of(played)
    assert found.endswith(f"; the right image lies {text}: the pair is not rectified")
    assert level == 1
    assert counts["measured"] > 0.05 * counts["pixels"]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"P": None}, "right_info.P must be given"),
        ({"P": np.array([[100, 0, 79.5, 20], [0, 100, 47.5, 0], [0, 0, 1, 0.0]])}, "P\\[0, 3\\] = -fx"),
        ({"P": np.array([[120, 0, 79.5, -20], [0, 120, 47.5, 0], [0, 0, 1, 0.0]])}, "one K for both"),
        ({"width": WIDTH + 1}, "right has 160x96 pixels, but right_info describes 161x96"),
        ({"frame": "other"}, "right is in frame 'right'"),
    ],
)
def test_a_calibration_that_does_not_fit_is_named(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(OperatorFailure, match=text):
        measured(*flat_pair(10.0), calibration=infos(**changes))


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"disparities": 40}, "multiple of 16"),
        ({"small_step": 40}, "must not exceed large_step"),
        ({"min_range": 200.0}, "must be below max_range"),
    ],
)
def test_parameters_that_contradict_each_other_are_named(params: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        StereoDepth(**params).setup()


def test_two_plays_are_equal_and_a_restored_operator_sums_up_alike() -> None:
    left, right, *_ = step_pair()
    streams: dict[str, Any] = {
        "left": [Image(stamp=k, frame="left", data=left) for k in (1, 2)],
        "right": [Image(stamp=k, frame="right", data=right) for k in (1, 2)],
        "left_info": [infos()[0]],
        "right_info": [infos()[1]],
    }
    assert counted_twice(lambda: StereoDepth(**SMALL), streams, ["left_info", "right_info"])["pairs"] == 2
