"""What the fusion cannot use is counted with its reason, and the rest goes on as if it had not come."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_sensors import ORIGIN, Robot, extrinsics, fused

from dataflow.messages import LandmarkSightings, MagneticField, Message, Odometry, Pose, RadarScan, Twist
from dataflow.operator import Context
from operators.fusion import EkfFusion

NAN = float("nan")
INDEFINITE = np.array([[1.0, 2, 0], [2, 1, 0], [0, 0, 1]])


def begun(**sensors: Any) -> EkfFusion:
    """An operator that has begun."""
    operator = EkfFusion(origin=ORIGIN, start="origin", sensors={f"robot/{k}": v for k, v in sensors.items()})
    operator.setup()
    for imu in Robot(1.0).imu:
        operator.process({"ns/robot/imu": imu}, Context(imu.stamp), extrinsics())
    return operator


def process(operator: EkfFusion, name: str, message: Message, **more: Any) -> None:
    operator.process({f"ns/robot/{name}": message}, Context(message.stamp), extrinsics(), **more)


def pose(covariance: Any = None, position: Any = (0, 0, 0)) -> Pose:
    C = np.eye(6) if covariance is None else covariance
    return Pose(
        stamp=19 * 10**8,
        frame="world",
        child_frame="base_link",
        position=position,
        orientation=[0, 0, 0, 1],
        covariance=C,
    )


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (pose(np.zeros((6, 6))), "covariance not positive"),
        (pose(np.full((6, 6), NAN)), "covariance not finite"),
        (pose(np.block([[INDEFINITE, np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])), "covariance not positive"),
        (pose(position=[NAN, 0, 0]), "not finite"),
        (MagneticField(stamp=19 * 10**8, frame="base_link", field=[0, 0, 0]), "no field"),
        (MagneticField(stamp=19 * 10**8, frame="base_link", field=[0, NAN, 0]), "not finite"),
        (
            Twist(stamp=19 * 10**8, frame="base_link", linear=[NAN, 0, 0], angular=[0, 0, 0], covariance=np.eye(6)),
            "not finite",
        ),
        (
            Odometry(
                stamp=19 * 10**8, frame="odom", child_frame="base_link", position=[0, 0, 0], orientation=[0, 0, 0, 1]
            ),
            "first of its kind",
        ),
        (RadarScan(stamp=19 * 10**8, frame="radar", ranges=[1.0], azimuths=[0.0]), "no Doppler velocities"),
        (LandmarkSightings(stamp=19 * 10**8, frame="base_link", ids=[1], ranges=[2.0]), "no map of landmarks"),
    ],
    ids=["zero", "nan covariance", "indefinite", "nan", "no field", "nan field", "twist", "first", "radar", "ranges"],
)
def test_a_message_that_cannot_be_used_is_counted(message: Message, reason: str) -> None:
    operator = begun(x={"sigma": None})
    before = operator.state.filter.estimate(19 * 10**8)[0]
    process(operator, "x", message)
    assert operator.summary()[f"ignored, robot/x: {reason}"] == 1
    after = operator.state.filter.estimate(19 * 10**8)[0]
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.covariance, before.covariance)


def test_unusable_detections_and_landmarks_are_counted_and_others_used() -> None:
    operator = begun(ranges={"sigma": 0.1})
    stamp = 19 * 10**8
    scan = RadarScan(stamp=stamp, frame="radar", ranges=[5.0] * 3, azimuths=[0.0, 0.1, NAN], velocities=[0.0, NAN, 0.0])
    process(operator, "radar", scan)
    world = LandmarkSightings(stamp=0, frame="world", ids=[1, 2], positions=[[2.0, 0, 0], [0, 3.0, 0]])
    seen = LandmarkSightings(stamp=stamp, frame="base_link", ids=[1, 2, 9], ranges=[2.0, NAN, 1.0])
    process(operator, "ranges", seen, landmark_map=world)
    figures = operator.summary()
    assert figures["ignored, robot/radar: detection not finite"] == 2
    assert figures["ignored, robot/ranges: not finite"] == 1
    assert figures["ignored, robot/ranges: landmark not in the map"] == 1
    decided = ("used", "refused", "unconfirmed")
    for name in ("radar", "ranges"):
        assert sum(int(figures[f"robot/{name}, {fate}"]) for fate in decided) == 1


def test_messages_that_do_not_come_after_the_last_are_counted_and_not_used_twice() -> None:
    operator = begun()
    for stamp in (1_900_000_000, 1_900_000_000, 1_800_000_000):
        process(operator, "x", pose().replace(stamp=stamp))
    imu = Robot(1.0).imu[-1]
    process(operator, "imu", imu)
    figures = operator.summary()
    assert figures["ignored, robot/x: stamp not later than the last"] == 2
    assert figures["ignored, robot/imu: stamp not later than the last"] == 1
    assert sum(int(figures[f"robot/x, {fate}"]) for fate in ("used", "refused", "unconfirmed")) == 1


def test_inertial_sample_without_covariance_takes_the_last_one() -> None:
    operator = begun()
    imu = Robot(1.2).imu[52]
    for k, C in enumerate((None, np.zeros((3, 3)), np.full((3, 3), NAN))):
        process(operator, "imu", imu.replace(stamp=imu.stamp + k * 20_000_000, angular_velocity_covariance=C))
    assert np.isfinite(operator.state.filter.estimate(imu.stamp + 40_000_000)[0].covariance).all()
    first = EkfFusion()
    first.setup()
    with pytest.raises(ValueError, match="so gyro_noise must say how good they are"):
        process(first, "imu", imu.replace(angular_velocity_covariance=np.zeros((3, 3))))


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_estimate_stays_finite_for_arbitrary_poses(data: st.DataObject) -> None:
    number = st.floats(allow_nan=True, allow_infinity=True, width=32)
    position = data.draw(st.lists(number, min_size=3, max_size=3))
    covariance = np.array(data.draw(st.lists(number, min_size=36, max_size=36))).reshape(6, 6)
    operator = begun(x={"use": "pose"})
    process(operator, "x", pose(covariance, position))
    at = operator.state.filter.estimate(2 * 10**9)[0]
    assert np.isfinite(at.covariance).all()
    assert np.isfinite(at.position).all()


def test_bad_messages_among_good_ones_do_not_change_the_result() -> None:
    robot = Robot(3.0)
    fixes = robot.fixes()
    clean, played = fused({"robot/imu": robot.imu, "robot/fix": fixes}, heading=None)
    broken = [m.replace(stamp=m.stamp + 1, covariance=np.zeros((3, 3))) for m in fixes]
    dirty, others = fused({"robot/imu": robot.imu, "robot/fix": fixes, "robot/bad": broken}, heading=None)
    assert [m.digest() for m in others["odometry"]] == [m.digest() for m in played["odometry"]]
    assert dirty.summary()["ignored, robot/bad: covariance not positive"] > 0
    assert "ignored, robot/bad: covariance not positive" not in clean.summary()
