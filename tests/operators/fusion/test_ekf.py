"""The fusion as an operator: sensors by type and setting, frames, bad input, and a state that goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_sensors import ORIGIN, RATE, T_BASE_IMU, Array, Robot, errors, extrinsics, fused
from operator_runs import assert_resumes_alike, firings_of
from scipy.spatial.transform import Rotation

from dataflow.messages import (
    Imu,
    LandmarkSightings,
    MagneticField,
    Message,
    NavSatFix,
    Odometry,
    Pose,
    RadarScan,
    Twist,
)
from dataflow.messages.geometry import matrix_to_quaternion, yaw_of
from dataflow.operator import Context, ParameterError
from dataflow.testing import play
from operators.fusion import EkfFusion
from operators.geometry.geodesy import earth_centred, east_north_up
from operators.simulator.sensors.gnss import geodetic


def twist(stamp: int, frame: str = "base_link") -> Twist:
    return Twist(stamp=stamp, frame=frame, linear=np.zeros(3), angular=np.zeros(3))


HEADING = {"heading": float(yaw_of(matrix_to_quaternion(T_BASE_IMU[:3, :3].T))) + 0.1, "heading_sigma": 0.3}


def test_satellites_pose_the_base_through_lever_arms() -> None:
    robot = Robot(8.0)
    operator, played = fused({"robot/imu": robot.imu, "robot/fix": robot.fixes()}, heading=None)
    position, orientation = errors(robot, played)
    assert position[-100:].max() < 0.1
    assert np.degrees(orientation[-100:].max()) < 3
    assert operator.summary()["robot/fix, refused"] == 0
    speed = played["odometry"][-1].linear
    h = 1 / RATE
    step = np.linalg.inv(robot.T_world_base[-2]) @ robot.T_world_base[-1]
    np.testing.assert_allclose(speed, step[:3, 3] / h, atol=0.1)


def test_the_place_of_a_fix_is_that_of_the_receiver_inverted() -> None:
    place = np.array([120.0, -80.0, 15.0])
    np.testing.assert_allclose(east_north_up(*geodetic(place, *ORIGIN), ORIGIN), place, atol=1e-6)
    assert abs(np.linalg.norm(earth_centred(0.0, 0.0, 0.0)) - 6378137.0) < 1e-6


@pytest.mark.parametrize("cls", [Pose, Odometry])
def test_absolute_poses_are_followed(cls: type) -> None:
    robot = Robot()
    settings = {"robot/pose": {"use": "pose"}}
    _, played = fused({"robot/imu": robot.imu, "robot/pose": robot.poses(cls)}, heading=None, sensors=settings)
    position, orientation = errors(robot, played)
    assert position.max() < 0.05
    assert np.degrees(orientation.max()) < 1.5


def test_odometry_without_velocity_counts_by_its_steps() -> None:
    robot = Robot()
    odometry = robot.poses(Odometry, frame="odom")
    settings = {"robot/vo": {"sigma": 0.02, "angular_sigma": 0.01}}
    operator, played = fused(
        {"robot/imu": robot.imu, "robot/vo": odometry}, start="origin", sensors=settings, heading=0.0
    )
    assert operator.summary()["robot/vo linear, used"] > 40
    moved = [m.matrix() for m in played["odometry"]]
    estimated = np.linalg.inv(moved[0]) @ moved[-1]
    rows = np.searchsorted(robot.stamps, [played["odometry"][0].stamp, played["odometry"][-1].stamp])
    true = np.linalg.inv(robot.T_world_base[rows[0]]) @ robot.T_world_base[rows[1]]
    assert np.linalg.norm(estimated[:3, 3] - true[:3, 3]) < 0.15


@pytest.mark.parametrize("settings", [{"use": "doppler", "sigma": 0.03}, {"sigma": 0.03}], ids=["doppler", "auto"])
def test_radar_measures_velocity_and_moving_detections_are_refused(settings: dict[str, Any]) -> None:
    robot = Robot()
    sensors = {"robot/radar": settings}
    operator, played = fused({"robot/imu": robot.imu, "robot/radar": robot.scans()}, start="origin", sensors=sensors)
    figures = operator.summary()
    assert figures["robot/radar, refused"] >= 0.8 * len(robot.scans()) - 8
    assert figures["robot/radar, used after making room"] == 0
    assert played["odometry"]


@pytest.mark.long
def test_a_clock_that_is_off_is_made_up_for_by_the_offset() -> None:
    robot = Robot()
    shifted = [m.replace(stamp=m.stamp + 200_000_000) for m in robot.fixes()]
    found = []
    for offset in (0.0, 0.2):
        sensors = {"robot/fix": {"offset": offset}}
        _, played = fused({"robot/imu": robot.imu, "robot/fix": shifted}, sensors=sensors, **HEADING)
        found.append(errors(robot, played)[0])
    assert max(one[-100:].mean() for one in found) < 0.06  # in the end, without being told as well
    assert found[1].max() < 0.5 * found[0].max()


def test_wheels_hold_a_robot_that_stands() -> None:
    robot = Robot(8.0)
    still = robot.imu[:25]
    drift, lean = np.array([0.01, 0.0, 0.02]), np.array([0.05, 0.0, 0.0])
    imu = [
        m.replace(
            stamp=10**9 + k * 20_000_000,
            angular_velocity=m.angular_velocity + drift,
            linear_acceleration=m.linear_acceleration + lean,
        )
        for k, m in enumerate(still * 16)
    ]
    wheels = [
        Twist(stamp=10**9 + k * 50_000_000, frame="base_link", linear=[0, 0, 0], angular=[0, 0, 0]) for k in range(150)
    ]
    sensors = {"robot/wheels": {"use": "wheels", "sigma": 0.02}}
    operator, played = fused({"robot/imu": imu, "robot/wheels": wheels}, start="origin", sensors=sensors)
    assert np.linalg.norm(played["odometry"][-1].position - played["odometry"][0].position) < 0.02
    assert operator.summary()["robot/wheels standstill, used"] > 100


@pytest.mark.parametrize("by_radar", [False, pytest.param(True, marks=pytest.mark.long)], ids=["sightings", "radar"])
def test_ranges_to_known_landmarks_and_a_magnetometer_place_it(by_radar: bool) -> None:
    robot = Robot(8.0)
    places = np.array([[5.0, 5, 2], [-5, 4, 0], [4, -6, 3], [-4, -5, 1]])
    world = LandmarkSightings(stamp=0, frame="world", ids=np.arange(4), positions=places)
    ranges, fields = list[Message](), []
    for k in range(0, len(robot.t), 5):
        T = robot.T_world_base[k]
        distances = np.linalg.norm(T[:3, 3] - places, axis=1)
        stamp = int(robot.stamps[k])
        if by_radar:
            given = {"ranges": distances.astype(np.float32), "azimuths": np.zeros(4, np.float32)}
            ranges.append(RadarScan(stamp=stamp, frame="base_link", ids=np.arange(4), **given))
        else:
            ranges.append(LandmarkSightings(stamp=stamp, frame="base_link", ids=np.arange(4), ranges=distances))
        fields.append(MagneticField(stamp=stamp, frame="base_link", field=T[:3, :3].T @ [0, 2e-5, -4e-5]))
    sensors = {"robot/ranges": {"use": "range", "sigma": 0.05}, "robot/field": {"angular_sigma": 0.05}}
    streams = {"robot/imu": robot.imu, "robot/ranges": ranges, "robot/field": fields, "robot/fix": robot.fixes()[:8]}
    operator, played = fused(streams, lists={"landmark_map": [world]}, sensors=sensors, **HEADING)
    position, orientation = errors(robot, played)
    assert position[-100:].max() < 0.2
    assert np.degrees(orientation[-100:].max()) < 5
    assert operator.summary()["robot/field, used"] > 50


def test_without_inertial_sensor_poses_are_smoothed() -> None:
    robot = Robot()
    operator, played = fused({"robot/pose": robot.poses()}, motion="constant_velocity", heading=None)
    position, _ = errors(robot, played)
    assert len(position) > 50
    assert position[5:].max() < 0.1
    assert operator.summary()["robot/pose, refused"] == 0


def test_control_input_bridges_an_outage_without_inertial_sensor() -> None:
    """A body on a circle at 1 m/s and 0.5 rad/s, whose positions end after 3 s."""
    stamps = [100_000_000 * k for k in range(1, 61)]
    circle = [transform(stamp * 1e-9) for stamp in stamps]
    poses = [
        Pose.from_matrix(T, stamp=s, frame="world", child_frame="base_link", covariance=np.eye(6) * 1e-4)
        for s, T in zip(stamps, circle, strict=True)
    ]
    told = [Twist(stamp=s + 1, frame="base_link", linear=[1, 0, 0], angular=[0, 0, 0.5]) for s in stamps]
    ends = []
    for commands in (told, told[:30]):
        operator = EkfFusion(
            motion="constant_velocity",
            free_acceleration=0.05,
            free_turning=0.05,
            sensors={"robot/pose": {"use": "pose"}, "robot/told": {"use": "control", "lag": 0.2}},
        )
        played = play(operator, {"measurements": {"robot/pose": poses[:30], "robot/told": commands}})
        state = operator.snapshot()
        other = EkfFusion(motion="constant_velocity", sensors=operator.sensors)
        other.setup()
        other.restore(state)
        assert other.summary() == operator.summary()
        ends.append(float(np.linalg.norm(operator.state.filter.estimate(stamps[-1])[0].position - circle[-1][:3, 3])))
        assert played["odometry"]
    assert ends[0] < 0.1
    assert operator.state.filter.estimate(stamps[-1])[0].covariance[0, 0] > 0.1**2


def transform(t: float) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 0.5 * t).as_matrix()
    T[:2, 3] = 2 * np.sin(0.5 * t), 2 - 2 * np.cos(0.5 * t)
    return T


def test_ignored_measurements_are_counted_by_reason() -> None:
    robot = Robot(3.0)
    fixes = robot.fixes()
    stamp = fixes[-1].stamp
    nan = float("nan")
    fixes[-1] = NavSatFix(stamp=stamp, frame="gnss", status="no_fix", latitude=nan, longitude=nan, altitude=nan)
    fixes[-2] = NavSatFix(
        stamp=fixes[-2].stamp, frame="gnss", latitude=48.1, longitude=11.5, altitude=500.0, covariance=np.zeros((3, 3))
    )
    imu = list(robot.imu)
    imu[60] = Imu(stamp=imu[60].stamp, frame="imu", angular_velocity=[nan, 0, 0], linear_acceleration=[0, 0, 9.8])
    operator, played = fused({"robot/imu": imu, "robot/fix": fixes}, **HEADING)
    figures = operator.summary()
    assert figures["ignored, robot/fix: no fix"] == 1
    assert figures["ignored, robot/fix: covariance not positive"] == 1
    assert figures["ignored, robot/imu: not finite"] == 1
    assert figures["ignored, robot/fix: before the beginning"] == 5
    status = played["status"][-1]
    assert status.names[0] == "filter"
    assert status.pairs(0)["robot/imu: not finite"] == "1"
    assert "robot/fix" in status.names


def test_fixes_without_altitude_correct_horizontally_and_are_reported() -> None:
    robot = Robot(10.0)
    operator, played = fused({"robot/imu": robot.imu, "robot/fix": robot.fixes(altitude=False)}, **HEADING)
    made: list[Any] = list(played["odometry"])
    assert len(made) > 400
    assert "height" in played["status"][-1].names
    assert any("altitude" in name for name in operator.summary())
    rows = np.searchsorted(robot.stamps, [m.stamp for m in made[-50:]])
    off = np.array([m.position for m in made[-50:]]) - np.array(robot.T_world_base)[rows, :3, 3]
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.15


@pytest.mark.parametrize(
    ("message", "settings", "words"),
    [
        (
            Pose(stamp=3 * 10**9, frame="odom", position=[0, 0, 0], orientation=[0, 0, 0, 1], covariance=np.eye(6)),
            {},
            "poses are in the frame 'odom', the filter's is 'world'",
        ),
        (twist(3 * 10**9), {}, "its sigma must say"),
        (twist(3 * 10**9), {"use": "pose"}, "Twist cannot"),
        (twist(3 * 10**9, "arm"), {"sigma": 1.0, "angular_sigma": 1.0}, "no transform between 'arm' and 'base_link'"),
        (
            Imu(stamp=3 * 10**9, frame="other", angular_velocity=[0, 0, 0], linear_acceleration=[0, 0, 9.8]),
            {},
            "a second inertial sensor, 'other' beside 'imu'",
        ),
    ],
    ids=["frame", "no covariance", "wrong use", "no place", "two inertial sensors"],
)
def test_a_sensor_that_cannot_be_used_is_named(message: Message, settings: dict[str, Any], words: str) -> None:
    robot = Robot(1.0)
    operator = EkfFusion(sensors={"robot/x": settings}, start="origin")
    operator.setup()
    for imu in robot.imu[:40]:
        operator.process({"ns/robot/imu": imu}, Context(imu.stamp), extrinsics())
    with pytest.raises(ValueError, match=words):
        operator.process({"ns/robot/x": message}, Context(message.stamp), extrinsics())


def test_settings_of_no_stream_are_reported_with_the_nearest_stream() -> None:
    robot = Robot(3.0)
    sensors = {"robot/pos": {"sigma": 0.1}, "robot/fx": {"sigma": 0.1}}
    operator = EkfFusion(sensors=sensors, origin=ORIGIN, **HEADING)
    streams = {"robot/imu": robot.imu, "robot/fix": robot.fixes(), "robot/pos": robot.poses(Pose)}
    given: dict[str, Any] = {"measurements": streams, "extrinsics": [extrinsics()]}
    played = play(operator, given, static=["extrinsics"])
    status = played["status"][-1]
    texts = dict(zip(status.names, status.messages, strict=True))
    assert texts["settings of robot/fx"] == "no stream so far has this name; the nearest is measurements/robot/fix"
    assert "settings of robot/pos" not in texts
    assert operator.summary()["settings of robot/fx"] == "of no stream; the nearest is measurements/robot/fix"


def test_settings_are_checked() -> None:
    with pytest.raises(ParameterError, match="sigma"):
        EkfFusion(sensors={"robot/fix": {"sigma": -1.0}})


def test_restored_operator_resumes_alike() -> None:
    robot = Robot(4.0)
    streams = {"robot/imu": robot.imu, "robot/fix": robot.fixes(), "robot/radar": robot.scans()}
    params: dict[str, Any] = {"sensors": {"robot/radar": {"use": "doppler"}}, **HEADING}
    assert_resumes_alike(lambda: EkfFusion(origin=ORIGIN, **params), firings_of(streams, extrinsics()), 110)
