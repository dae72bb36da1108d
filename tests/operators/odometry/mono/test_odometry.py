"""The monocular odometry operator: what its messages say of the scale, its status, its memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_walls import RATE, SIZE, K, aside, rendered
from operator_runs import assert_one_calibration, assert_resumes_alike, texts

from dataflow.messages import CameraInfo, Image, Odometry, Transforms
from dataflow.operator import Context
from dataflow.testing import Played, play
from operators.fusion import EkfFusion
from operators.fusion.sensors.settings import SensorSettings
from operators.geometry import se3
from operators.odometry import MonoVisualOdometry
from operators.odometry.mono.settings import MonoOdometryConfig

STATIC = ("image_info", "extrinsics")
# The camera looks along the robot's x axis, half a metre above it.
MOUNT = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.0], [0, -1, 0, 0.5], [0, 0, 0, 1]])


def streams(count: int, wheels: bool = False) -> dict[str, list[Any]]:
    stamps = [10**9 // RATE * (k + 1) for k in range(count)]
    given: dict[str, list[Any]] = {
        "image": [Image(stamp=s, frame="camera", data=i) for s, i in zip(stamps, rendered(count), strict=True)],
        "image_info": [CameraInfo(stamp=0, frame="camera", width=SIZE[0], height=SIZE[1], K=K)],
    }
    if wheels:
        given["scale"] = [
            Odometry.from_matrix(MOUNT @ T @ np.linalg.inv(MOUNT), stamp=s, frame="wheel_odom", child_frame="base_link")
            for s, T in zip(stamps, aside(count), strict=True)
        ]
        given["extrinsics"] = [Transforms.from_matrix(MOUNT, stamp=0, frame="base_link", child_frame="camera")]
    return given


def run(given: dict[str, list[Any]], **params: Any) -> Played:
    return play(MonoVisualOdometry(**params), given, static=STATIC)


def test_message_of_an_unknown_scale_has_infinite_variance_and_its_own_frame() -> None:
    played = run(streams(16))
    poses: list[Any] = list(played["odometry"])
    said = texts(played)
    assert len(said) == 16
    assert len(poses) == sum(not text.startswith("initialising") for text in said)
    for pose in poses:
        assert (pose.frame, pose.child_frame) == ("odom_unscaled", "camera")
        assert np.isinf(np.diag(pose.pose_covariance)[:3]).all()
        assert np.isfinite(pose.pose_covariance[3:, 3:]).all()
        assert pose.linear is None
        assert pose.angular is not None
    assert said[-1].startswith("tracking: ")
    assert said[-1].endswith("; scale unknown")


def test_wheels_give_metres_and_a_covariance() -> None:
    played = run(streams(30, wheels=True))
    poses: list[Any] = list(played["odometry"])
    truth = {10**9 // RATE * (k + 1): T for k, T in enumerate(aside(30))}
    assert {p.frame for p in poses} == {"odom"}
    assert np.isfinite(poses[-1].pose_covariance).all()
    way = np.linalg.norm(poses[-1].position - poses[0].position)
    true = np.linalg.norm((truth[poses[-1].stamp] - truth[poses[0].stamp])[:3, 3])
    assert way == pytest.approx(float(true), rel=0.03)
    assert "scale known to" in texts(played)[-1]


def test_an_odometry_of_another_stamp_is_carried_to_the_image_by_its_velocity() -> None:
    given, twist = streams(1, wheels=True), np.array([0.5, -0.1, 0.0, 0.0, 0.2, 0.6])
    image, T = given["image"][0], se3.exp(np.array([3.0, 1.0, 0.0, 0.0, 0.0, 0.5]))
    then = Odometry.from_matrix(
        T, stamp=image.stamp - 40_000_000, frame="wheel_odom", child_frame="base_link", linear=twist[:3],
        angular=twist[3:],
    )  # fmt: skip
    operator = MonoVisualOdometry()
    operator.setup()
    operator.process(image, given["image_info"][0], then, given["extrinsics"][0])
    np.testing.assert_allclose(operator.state.odometry.T_reference, T @ se3.exp(0.04 * twist) @ MOUNT, atol=1e-9)
    lost = then.replace(position=[np.nan, 0.0, 0.0])
    operator.process(image.replace(stamp=image.stamp + 1), given["image_info"][0], lost, given["extrinsics"][0])
    assert operator.state.odometry.T_reference is None


def test_default_parameters_equal_the_default_settings() -> None:
    assert MonoVisualOdometry()._config() == MonoOdometryConfig()


def test_a_scale_without_a_place_for_the_camera_is_refused() -> None:
    given = streams(1, wheels=True)
    operator = MonoVisualOdometry()
    operator.setup()
    with pytest.raises(ValueError, match="base_link"):
        operator.process(given["image"][0], given["image_info"][0], given["scale"][0], None)


def test_fusion_takes_no_metres_from_poses_without_scale() -> None:
    poses: list[Any] = list(run(streams(16))["odometry"])
    fusion = EkfFusion(
        motion="constant_velocity",
        start="origin",
        base_frame="camera",
        sensors={"mono/odometry": SensorSettings(sigma=0.05, angular_sigma=0.05)},
    )
    fusion.setup()
    for pose in poses:
        fusion.process({"ns/mono/odometry": pose}, Context(pose.stamp))
    figures = fusion.summary()
    assert figures["ignored, mono/odometry: scale unknown"] == len(poses) - 1
    assert figures["mono/odometry angular, used"] > 0
    assert "mono/odometry linear, used" not in figures


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    given = streams(20, wheels=True)
    info, extrinsics = given["image_info"][0], given["extrinsics"][0]
    firings = [(image, info, scale, extrinsics) for image, scale in zip(given["image"], given["scale"], strict=True)]
    assert_resumes_alike(MonoVisualOdometry, firings, 12)


def test_a_reset_clock_begins_a_new_path() -> None:
    given = streams(12)
    operator = MonoVisualOdometry()
    operator.setup()
    for image in given["image"]:
        operator.process(image, given["image_info"][0])
    operator.on_reset("image")
    sent = operator.process(given["image"][0], given["image_info"][0])
    assert "odometry" not in sent
    assert sent["status"].messages[0].startswith("initialising")


@pytest.mark.long
def test_repeated_calibration_is_the_same_and_another_is_refused() -> None:
    given = streams(16)
    other = given["image_info"][0].replace(K=np.diag([1.1, 1.1, 1.0]) @ given["image_info"][0].K)
    assert_one_calibration(MonoVisualOdometry, given, ["image_info"], "image", other, 9)
