"""Images, depth, scans and velocities that tell nothing are survived by the checks; what does not fit is named."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from dataflow import Played, play
from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, DepthImage, Image, Odometry, PointCloud
from dataflow.messages.diagnostics import Level
from operators.monitoring import ColorDepthCheck, DepthScanCheck
from tests.operators.monitoring.rooms import HEIGHT, WIDTH, extrinsics, info, views

BAD = range(4, 7)
DEPTHS = {
    "no return": np.zeros((HEIGHT, WIDTH), np.float32),
    "nothing finite": np.full((HEIGHT, WIDTH), np.nan, np.float32),
    "infinite": np.full((HEIGHT, WIDTH), np.inf, np.float32),
    "negative": np.full((HEIGHT, WIDTH), -1.0, np.float32),
    "a blank wall": np.full((HEIGHT, WIDTH), 2.0, np.float32),
}
IMAGES = {"black": 0, "white": 255}
SCANS = {
    "empty": np.zeros((0, 3), np.float32),
    "one point": np.ones((1, 3), np.float32),
    "nothing finite": np.full((500, 3), np.nan, np.float32),
    "nothing that a sensor could see": np.full((500, 3), 1e18, np.float32),
}


@cache
def room() -> tuple[list[DepthImage], list[Image], list[PointCloud]]:
    depths, images, clouds = zip(*views(14), strict=True)
    return list(depths), list(images), list(clouds)


def colors_checked(images: list[Image], depths: list[DepthImage], depth_info: CameraInfo | None = None) -> Played:
    infos = {"image_info": [info("color")], "depth_info": [depth_info or info("depth")], "extrinsics": [extrinsics()]}
    return play(ColorDepthCheck(period="200ms"), {"image": images, "depth": depths} | infos, static=list(infos))


def scans_checked(clouds: list[PointCloud], depths: list[DepthImage], **more: list[Odometry]) -> Played:
    static = {"depth_info": [info("depth")], "extrinsics": [extrinsics()]}
    return play(DepthScanCheck(), {"cloud": clouds, "depth": depths} | static | more, static=list(static))


def assert_no_alarm(played: Played, firings: int) -> None:
    assert [s.levels[0] for s in played["status"]] == [Level.OK] * firings


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bad", DEPTHS.values(), ids=DEPTHS)
def test_depths_that_tell_nothing_among_good_ones_raise_no_alarm(bad: np.ndarray) -> None:
    depths, images, clouds = room()
    given = [d.replace(data=bad) if k in BAD else d for k, d in enumerate(depths)]
    assert_no_alarm(colors_checked(images, given), len(images))
    played = scans_checked(clouds, given)
    assert_no_alarm(played, len(clouds))
    if bad[0, 0] != 2.0:
        assert played["status"][-1].pairs(0)["with few common surfaces"] == str(len(BAD))


@pytest.mark.parametrize("bad", IMAGES.values(), ids=IMAGES)
def test_images_that_show_nothing_among_good_ones_raise_no_alarm(bad: int) -> None:
    depths, images, _ = room()
    given = [i.replace(data=np.full_like(i.data, bad)) if k in BAD else i for k, i in enumerate(images)]
    assert_no_alarm(colors_checked(given, depths), len(images))


@pytest.mark.parametrize("bad", SCANS.values(), ids=SCANS)
def test_scans_that_tell_nothing_among_good_ones_are_counted_and_raise_no_alarm(bad: np.ndarray) -> None:
    depths, _, clouds = room()
    given = [PointCloud(stamp=c.stamp, frame=c.frame, points=bad) if k in BAD else c for k, c in enumerate(clouds)]
    played = scans_checked(given, depths)
    assert_no_alarm(played, len(clouds))
    assert played["status"][-1].pairs(0)["with few common surfaces"] == str(len(BAD))


def test_scans_with_a_velocity_that_is_not_finite_are_counted_and_raise_no_alarm() -> None:
    depths, _, clouds = room()
    timed = [c.replace(time_offsets=np.full(c.count, 0.01, np.float32)) for c in clouds]
    motion = [
        Odometry.from_matrix(
            np.eye(4), stamp=c.stamp, frame="odom", child_frame="lidar", angular=[0, 0, 0],
            linear=[np.nan if k in BAD else 0, 0, 0],
        )
        for k, c in enumerate(clouds)
    ]  # fmt: skip
    played = scans_checked(timed, depths, motion=motion)
    assert_no_alarm(played, len(clouds))
    assert played["status"][-1].pairs(0)["with few common surfaces"] == str(len(BAD))


def test_mismatched_calibrations_and_unrelated_frames_are_named() -> None:
    depths, images, clouds = room()
    small = [d.replace(data=d.data[:120, :160]) for d in depths]
    masts, high = [i.replace(frame="mast") for i in images], [c.replace(frame="mast") for c in clouds]
    size = "depth has 160x120 pixels, but depth_info describes 320x240"
    for check, given, text in (
        (colors_checked, (images, small), size), (scans_checked, (clouds, small), size),
        (colors_checked, (masts, depths), "'mast'"), (scans_checked, (high, depths), "'mast'"),
    ):  # fmt: skip
        with pytest.raises(OperatorFailure, match=text):
            check(*given)
