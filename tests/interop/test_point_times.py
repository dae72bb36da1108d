"""Times of points in whatever unit a driver gives them; calibrations of binned sensors; fields that are not known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_bags import SECOND, header, ros, xyzw

from dataflow.interop.access_tracking import TrackedMessage
from dataflow.interop.ros.clouds import point_times
from dataflow.interop.ros.images import camera_info, compressed
from dataflow.interop.ros.poses import transforms
from dataflow.interop.ros.sensors import imu, joint_state, nav_sat_fix
from dataflow.messages import CompressedDepth, CompressedImage
from dataflow.recording import RecordingError

STAMP = 1_700_000_000 * SECOND + 123_456_789
SWEEP = np.linspace(0, 0.099, 50)
UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


@pytest.mark.parametrize(
    ("unit", "dtype", "since"),
    [
        ("ns", "u4", "stamp"),  # Ouster
        ("ns", "f8", "epoch"),  # Livox ROS driver 2
        ("ns", "i8", "epoch"),
        ("us", "f8", "epoch"),
        ("us", "u8", "epoch"),
        ("ms", "f8", "epoch"),
        ("s", "f4", "stamp"),  # Velodyne
        ("s", "f8", "epoch"),  # Hesai, RoboSense
        ("us", "f4", "stamp"),
        ("ns", "f4", "stamp"),
        ("ns", "f8", "stamp"),
        ("us", "u4", "stamp"),
        ("ms", "f4", "stamp"),
    ],
)
def test_times_of_points_in_every_unit_are_seconds_since_the_stamp(unit: str, dtype: str, since: str) -> None:
    values = SWEEP * UNITS[unit] + (STAMP / 1e9 * UNITS[unit] if since == "epoch" else 0)

    offsets, odd = point_times(values.astype(dtype), STAMP, period=0.1)

    assert not odd
    np.testing.assert_allclose(offsets, SWEEP, atol=2e-6 if unit != "ms" else 1e-3)


def test_times_before_the_stamp_stay_negative() -> None:
    np.testing.assert_allclose(point_times((SWEEP - 0.1).astype("f4"), STAMP)[0], SWEEP - 0.1, atol=1e-6)


def test_times_of_another_clock_are_counted_from_the_first_point_and_named() -> None:
    values = (SWEEP * 1e9 + STAMP + 3600 * SECOND).astype("i8")

    offsets, odd = point_times(values, STAMP)

    np.testing.assert_allclose(offsets, SWEEP, atol=1e-6)
    assert "another clock" in odd


@pytest.mark.parametrize(
    "values",
    [
        [0.0, 1e30],
        [0.0, 0.5, 1.0],  # shares of a sweep
    ],
)
def test_times_that_make_no_sense_are_not_known_and_named(values: list[float]) -> None:
    offsets, odd = point_times(np.array(values, "f8"), STAMP, period=0.1)

    assert offsets is None
    assert "make no sense" in odd


K = np.array([400.0, 0, 320, 0, 400, 240, 0, 0, 1])
P = np.array([400.0, 0, 320, -40, 0, 400, 240, 0, 0, 0, 1, 0])


def info(width: int = 640, height: int = 480, binning: int = 0, roi: tuple[int, int, int, int] = (0, 0, 0, 0)) -> Any:
    x, y, w, h = roi
    part = ros("sensor_msgs/RegionOfInterest", x_offset=x, y_offset=y, width=w, height=h)
    fields = {"width": width, "height": height, "k": K, "p": P, "binning_x": binning, "binning_y": binning}
    return ros("sensor_msgs/CameraInfo", header=header(STAMP, "camera"), roi=part, **fields)


@pytest.mark.parametrize(
    ("given", "size", "focal", "centre", "baseline"),
    [
        (info(), (640, 480), 400, (320, 240), -40),
        (info(binning=1), (640, 480), 400, (320, 240), -40),
        (info(binning=2), (320, 240), 200, (160, 120), -20),
        (info(320, 240, binning=2), (320, 240), 200, (160, 120), -20),  # the size of the image beside the sensor's K
        (info(roi=(100, 50, 200, 100)), (200, 100), 400, (220, 190), -40),
        (info(binning=2, roi=(100, 50, 200, 100)), (100, 50), 200, (110, 95), -20),
    ],
)
def test_calibration_is_that_of_the_image_that_is_read_out(
    given: Any, size: tuple[int, int], focal: float, centre: tuple[float, float], baseline: float
) -> None:
    made = camera_info(given, STAMP)

    assert (made.width, made.height) == size
    assert (made.fx, made.fy, made.cx, made.cy) == (focal, focal, *centre)
    assert made.P is not None
    assert (made.P[0, 0], made.P[0, 2], made.P[0, 3]) == (focal, centre[0], baseline)


def test_a_region_outside_of_the_sensor_is_refused() -> None:
    with pytest.raises(RecordingError, match="does not lie in the sensor of 640x480"):
        camera_info(info(roi=(600, 0, 100, 100)), STAMP)


def png(dtype: str) -> Any:
    import cv2

    return cv2.imencode(".png", np.full((8, 8), 70, dtype))[1].reshape(-1)


@pytest.mark.parametrize(
    ("format_", "kind"),
    [
        ("mono16; png compressed ", CompressedImage),
        ("16UC1; png compressed ", CompressedDepth),
        ("png", CompressedDepth),
        ("rgb8; png compressed bgr8", CompressedImage),
    ],
)
def test_format_decides_whether_16_bits_are_grey_or_depth(format_: str, kind: type[Any]) -> None:
    assert type(compressed(format_, png("u2"), "camera", STAMP)) is kind


def test_a_field_that_holds_nothing_sensible_is_unknown_and_the_rest_is_read() -> None:
    bad = float("nan")
    joints = joint_state(ros("sensor_msgs/JointState", header=header(STAMP), position=np.arange(8.0)), STAMP)
    reading = imu(ros("sensor_msgs/Imu", header=header(STAMP), orientation=xyzw(bad, bad, bad, bad)), STAMP)
    fix = nav_sat_fix(ros("sensor_msgs/NavSatFix", header=header(STAMP), latitude=bad, longitude=bad), STAMP)
    distorted = info()
    distorted.d = np.full(5, bad)

    assert joints.names == tuple("01234567")
    assert reading.orientation is None
    assert fix.status == "no_fix"
    assert camera_info(distorted, STAMP).distortion is None


def test_values_of_another_number_than_the_joints_are_unknown_and_named() -> None:
    seen = TrackedMessage(ros("sensor_msgs/JointState", name=["a", "b"], position=np.zeros(2), effort=np.zeros(1)))

    joints = joint_state(seen, STAMP)

    assert joints.efforts is None
    assert seen.unread() == ("effort, of 1 joints where 2 are named",)


def test_a_transform_whose_rotation_is_nan_is_left_out_of_its_set() -> None:
    from made_bags import transform

    good, bad = transform(STAMP, "map", "odom"), transform(STAMP, "odom", "base")
    bad.transform.rotation = xyzw(float("nan"), 0, 0, 0)

    assert transforms([good, bad], STAMP).child_frames == ("odom",)
