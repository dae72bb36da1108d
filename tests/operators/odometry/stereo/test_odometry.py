"""The stereo odometry operator on pairs of a made wall: frames, status, faults, a clock that begins anew."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from operator_runs import assert_one_calibration

from dataflow.messages import CameraInfo, Image
from dataflow.testing import Played, play
from operators.odometry import StereoVisualOdometry

Gray = NDArray[np.uint8]

SIZE = (360, 180)
FOCAL, BASELINE = 260.0, 0.2
K = np.array([[FOCAL, 0.0, 179.5], [0.0, FOCAL, 89.5], [0.0, 0.0, 1.0]])
STEP = 0.03  # metres to the right, a frame
STATIC = ("left_info", "right_info")


@cache
def wall() -> Gray:
    """Smooth random spots: corners at every scale."""
    rng = np.random.default_rng(8)
    layers = [
        cv2.resize(rng.random((n, n), np.float32), (1600, 1600), interpolation=cv2.INTER_CUBIC) for n in (30, 100, 320)
    ]
    return np.clip((sum(layers) / 3.0 - 0.5) * 400 + 128, 0, 255).astype(np.uint8)


@cache
def seen_from(x: float) -> Gray:
    """A corner of two walls, 3 m away and receding by one metre in two, from a camera that is x metres to the right."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    ray, down = (u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL
    # The walls are z = 3 + |X| / 2, X = x + ray z.
    z = np.where(3 + x / 2 > 0, (3 + x / 2) / np.maximum(1 - ray / 2, 0.1), 0)
    X = x + ray * z
    left = X < 0
    z = np.where(left, (3 - x / 2) / np.maximum(1 + ray / 2, 0.1), z)
    X = x + ray * z
    rng = np.random.default_rng(int(1e4 * (x + 1)))
    shown = cv2.remap(wall(), (X * 200 + 800).astype(np.float32), (down * z * 200 + 800).astype(np.float32), 1)
    return np.clip(shown + rng.normal(0, 1.5, shown.shape), 0, 255).astype(np.uint8)


def info(frame: str, baseline: float) -> CameraInfo:
    P = np.column_stack([K, [-FOCAL * baseline, 0.0, 0.0]])
    return CameraInfo(stamp=0, frame=frame, width=SIZE[0], height=SIZE[1], K=K, P=P)


def streams(count: int, black: range = range(0), baseline: float = BASELINE) -> dict[str, list[Any]]:
    images: dict[str, list[Any]] = {"left": [], "right": []}
    for k in range(count):
        for name, x in (("left", STEP * k), ("right", STEP * k + BASELINE)):
            data = np.zeros(SIZE[::-1], np.uint8) if k in black else seen_from(x)
            images[name].append(Image(stamp=100_000_000 * (k + 1), frame=name, data=data))
    return images | {"left_info": [info("left", 0.0)], "right_info": [info("right", baseline)]}


def run(given: dict[str, list[Any]], **params: Any) -> Played:
    return play(StereoVisualOdometry(**params), given, static=STATIC)


def words(played: Played) -> list[str]:
    return [status.messages[0].split(":")[0] for status in played["status"]]


def test_the_left_camera_is_followed_in_named_frames() -> None:
    played = run(streams(12), odometry_frame="start")
    poses: list[Any] = list(played["odometry"])
    assert {(p.frame, p.child_frame) for p in poses} == {("start", "left")}
    assert [p.stamp for p in poses] == [s.stamp for s in played["status"]]
    assert set(words(played)) == {"tracking"}
    truth = np.column_stack([STEP * np.arange(12), np.zeros(12), np.zeros(12)])
    np.testing.assert_allclose([p.position for p in poses], truth, atol=0.02)
    np.testing.assert_array_equal(poses[0].matrix(), np.eye(4))
    assert poses[-1].linear[0] == pytest.approx(10 * STEP, rel=0.2)


def test_black_pairs_are_reported_and_bridged() -> None:
    played = run(streams(12, black=range(6, 8)))
    assert words(played)[6:8] == ["predicted", "predicted"]
    assert "black" in played["status"][6].messages[0]
    assert words(played)[-1] in ("tracking", "relocalised")
    poses: list[Any] = list(played["odometry"])
    assert np.trace(poses[7].pose_covariance[:3, :3]) > np.trace(poses[5].pose_covariance[:3, :3])
    assert poses[-1].position[0] == pytest.approx(11 * STEP, abs=0.04)


def test_counts_of_frames_are_summed_up_and_a_reset_clock_begins_a_new_path() -> None:
    operator = StereoVisualOdometry()
    operator.setup()
    given = streams(4)
    for k in (0, 1, 2, 3):
        sent = operator.process(given["left"][k], given["right"][k], given["left_info"][0], given["right_info"][0])
    assert sent["odometry"].position[0] > 2 * STEP
    operator.on_reset("left")
    sent = operator.process(given["left"][0], given["right"][0], given["left_info"][0], given["right_info"][0])
    assert sent["odometry"].position.tolist() == [0.0, 0.0, 0.0]
    assert operator.summary() == {"tracking": 5}


def test_wrong_calibrations_are_refused() -> None:
    given = streams(1)
    operator = StereoVisualOdometry()
    operator.setup()
    pair = (given["left"][0], given["right"][0])
    with pytest.raises(ValueError, match="baseline"):
        operator.process(*pair, info("left", 0.0), info("right", 0.0))
    small = Image(stamp=5, frame="left", data=np.zeros((90, 180), np.uint8))
    with pytest.raises(ValueError, match="180x90"):
        operator.process(small, pair[1], info("left", 0.0), info("right", BASELINE))


def test_repeated_calibration_is_the_same_and_another_is_refused() -> None:
    assert_one_calibration(StereoVisualOdometry, streams(6), STATIC, "left", info("right", 2 * BASELINE), 3)
