"""Faults, lamps and kidnappings happen in their spans, and only there."""

from __future__ import annotations

from typing import Any

import made_robot
import numpy as np
import pytest
from made_robot import OFF, QUIET, SMALL

from dataflow.messages.geometry import invert
from dataflow.operator import ParameterError
from operators.simulator import SimulatedRobot
from operators.simulator.events import Fault, FaultPlan, changes
from operators.simulator.settings import Lidar


def run(**params: Any) -> dict[str, list[Any]]:
    return made_robot.run(**{**OFF, "seed": 4, "movers": False, **params})


def seconds(messages: list[Any]) -> np.ndarray:
    return np.array([message.stamp for message in messages]) * 1e-9


def fault(sensor: str, span: tuple[float, float], **values: Any) -> dict[str, Any]:
    return {"sensor": sensor, "span": span, "set": values}


PORTS = {
    "color_camera": "image",
    "depth_camera": "depth",
    "stereo": "left",
    "lidar": "points",
    "inertial": "imu",
    "magnetometer": "magnetic_field",
    "wheels": "wheel_odometry",
    "radar": "radar_scan",
    "landmarks": "sightings",
    "gnss": "fix",
}
ALL: dict[str, Any] = {
    "duration": "1s",
    "color_camera": {"rate": 10, **SMALL, "read_noise": 0, "shot_noise": 0, "exposure_change": 0},
    "stereo": {"rate": 10, **SMALL},
    "lidar": {"rate": 10, "rings": 4, "columns": 60},
    **{name: {"rate": 10} for name in ("depth_camera", "inertial", "magnetometer", "wheels")},
    **{name: {"rate": 10} for name in ("radar", "landmarks", "gnss")},
}
KNOCK = (0.05, -0.02, 0.0, 0.0, 0.0, 0.1)


@pytest.fixture(scope="module")
def healthy() -> dict[str, list[Any]]:
    return run(**ALL)


@pytest.fixture(scope="module")
def frozen() -> dict[str, list[Any]]:
    return run(**ALL, faults=[fault(sensor, (0.35, 0.65), frozen=1.0) for sensor in PORTS])


@pytest.fixture(scope="module")
def faulty() -> dict[str, list[Any]]:
    return run(
        **ALL,
        faults=[
            fault("lidar", (0.5, 0.8), bias=0.3),
            fault("color_camera", (0.3, 0.6), black=1.0),
            fault("color_camera", (0.8, 9.0), mount_error=KNOCK),
            fault("depth_camera", (0.2, 0.6), missing=0.5),
            fault("inertial", (0.2, 0.4), dropout=1.0),
        ],
    )


@pytest.mark.long
@pytest.mark.parametrize("sensor", PORTS)
def test_a_frozen_sensor_repeats_its_last_measurement(
    sensor: str, healthy: dict[str, list[Any]], frozen: dict[str, list[Any]]
) -> None:
    right, stuck = healthy[PORTS[sensor]], frozen[PORTS[sensor]]
    assert len(right) == 10
    assert [m.stamp for m in stuck] == [m.stamp for m in right]
    for k, message in enumerate(stuck):
        assert message == right[3 if k in (4, 5, 6) else k].replace(stamp=message.stamp)


@pytest.mark.long
def test_a_fault_is_there_in_its_span_and_nowhere_else(
    healthy: dict[str, list[Any]], faulty: dict[str, list[Any]]
) -> None:
    for k, (a, b) in enumerate(zip(healthy["points"], faulty["points"], strict=True)):
        longer = np.linalg.norm(b.points, axis=1) - np.linalg.norm(a.points, axis=1)
        assert np.median(longer) == pytest.approx(0.3 if 5 <= k < 8 else 0, abs=0.01)
        assert 5 <= k < 8 or a == b
    assert faulty["left"] == healthy["left"]


def test_a_sensor_drops_out_in_a_span(faulty: dict[str, list[Any]]) -> None:
    assert [m.stamp // 10**8 for m in faulty["imu"]] == [0, 1, 4, 5, 6, 7, 8, 9]


def test_a_camera_goes_black_in_a_span(faulty: dict[str, list[Any]]) -> None:
    assert [m.data.mean() < 5 for m in faulty["image"]] == [False] * 3 + [True] * 3 + [False] * 4


def test_a_share_of_the_depth_is_missing_in_patches(
    healthy: dict[str, list[Any]], faulty: dict[str, list[Any]]
) -> None:
    for k, (a, b) in enumerate(zip(healthy["depth"], faulty["depth"], strict=True)):
        if not 2 <= k < 6:
            assert a == b
            continue
        gone = (a.data > 0) & (b.data == 0)
        assert gone.sum() / (a.data > 0).sum() == pytest.approx(0.5, abs=0.2)
        assert (a.data[b.data > 0] == b.data[b.data > 0]).all()
        assert (np.diff(gone.astype(int), axis=1) != 0).mean() < 0.3  # patches; of specks it would be half


def test_knocked_camera_deviates_from_its_calibration(
    healthy: dict[str, list[Any]], faulty: dict[str, list[Any]]
) -> None:
    apart = [(a.data != b.data).mean() for a, b in zip(healthy["image"], faulty["image"], strict=True)]
    assert max(apart[:3]) == max(apart[6:8]) == 0
    assert min(apart[8:]) > 0.3
    assert faulty["extrinsics"] == healthy["extrinsics"]


def test_the_true_pose_is_that_of_a_knocked_depth_camera() -> None:
    error = (0.1, 0.0, 0.0, 0.0, 0.0, 0.0)  # its housing is 10 cm farther ahead
    on: dict[str, Any] = {"duration": "100ms", "depth_camera": {"rate": 0}, "truth": {**QUIET, "poses": 10}}
    (plain,) = run(**on)["ground_truth"]
    (knocked,) = run(**{**on, "depth_camera": {"rate": 0, "mount_error": error}})["ground_truth"]
    between = invert(plain.matrix()) @ knocked.matrix()
    np.testing.assert_allclose(between[:3, 3], [0, 0, 0.1], atol=1e-9)  # z of the optical frame looks ahead


def test_a_wrong_focal_length_is_in_the_calibration_alone(healthy: dict[str, list[Any]]) -> None:
    wrong = run(**{**ALL, "duration": "100ms", "color_camera": {**ALL["color_camera"], "focal_error": 0.1}})
    assert wrong["image"] == healthy["image"][:1]
    assert wrong["image_info"][0].fx == pytest.approx(1.1 * healthy["image_info"][0].fx)


def test_drifting_clock_delays_measurements_increasingly() -> None:
    quiet = {"rate": 50, "gyro_noise": 0, "gyro_walk": 0, "accel_noise": 0, "accel_walk": 0}
    right, wrong = (run(duration="4s", inertial={**quiet, "clock_drift": drift})["imu"] for drift in (0.0, 0.05))
    rate = [np.array([m.angular_velocity[2] for m in stream]) for stream in (right, wrong)]
    times = seconds(right)
    np.testing.assert_allclose(rate[1], np.interp(times * 0.95, times, rate[0]), atol=1e-3)


def test_lamps_that_are_switched_off_darken_the_room_in_their_span(healthy: dict[str, list[Any]]) -> None:
    camera = ALL["color_camera"]
    dark = run(duration="1s", color_camera=camera, lighting=[{"span": [0.3, 0.7], "level": 0.1}])["image"]
    for k, (a, b) in enumerate(zip(healthy["image"], dark, strict=True)):
        if 3 <= k < 7:
            assert 5 < b.data.mean() < 0.75 * a.data.mean()
        else:
            assert a == b


@pytest.mark.long
def test_a_kidnapped_robot_leaps_and_its_sensors_do_not_notice() -> None:
    given: dict[str, Any] = {
        "duration": "8s", "wheels": {"rate": 20}, "inertial": {"rate": 50, "accel_noise": 0, "gyro_noise": 0},
        "truth": {**QUIET, "poses": 20, "events": True}, "kidnaps": [{"at": 4.0, "ahead": 0.5}],
    }  # fmt: skip
    found = run(**given)
    places = np.array([m.position for m in found["true_base"]])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.argmax() == 79  # from 3.95 to 4.00 s
    assert steps.max() > 1
    assert np.delete(steps, 79).max() < 0.05
    odometry = np.array([m.position for m in found["wheel_odometry"]])
    assert np.linalg.norm(np.diff(odometry, axis=0), axis=1).max() < 0.06
    assert max(np.abs(m.linear_acceleration[:2]).max() for m in found["imu"]) < 1
    (event,) = found["events"]
    assert (event.stamp, event.names) == (4_000_000_000, ("kidnap",))


def test_events_report_begin_and_end_of_faults() -> None:
    found = run(
        duration="3s", inertial={"rate": 1}, truth={**QUIET, "events": True},
        faults=[fault("inertial", (1.0, 2.0), frozen=1.0)], lighting=[{"span": [1.0, 2.5], "level": 0}],
    )["events"]  # fmt: skip
    assert [(m.stamp // 10**6, m.names, m.levels.tolist()) for m in found] == [
        (1000, ("inertial", "lighting"), [1, 1]),
        (2000, ("inertial",), [0]),
        (2500, ("lighting",), [0]),
    ]
    assert found[0].messages == ("frozen 1.0 begins", "lamps at 0 begins")


def test_where_faults_overlap_the_later_in_the_list_decides() -> None:
    plan = FaultPlan(
        [
            Fault(sensor="lidar", span=(0, 10), set={"noise": 0.1, "missing": 0.5}),
            Fault(sensor="lidar", span=(5, 6), set={"noise": 0.2}),
            Fault(sensor="radar", span=(0, 10), set={"clutter": 9}),
        ]
    )
    base = Lidar(rate=10)
    assert plan.at("lidar", base, 11.0) is base
    assert (plan.at("lidar", base, 1.0).noise, plan.at("lidar", base, 1.0).missing) == (0.1, 0.5)
    assert (plan.at("lidar", base, 5.0).noise, plan.at("lidar", base, 5.0).missing) == (0.2, 0.5)
    assert len(changes([], [], [])) == 0


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"faults": [fault("lidar", (0, 1), rate=3)]}, "rate of lidar cannot change"),
        ({"faults": [fault("lidar", (0, 1), nois=3)]}, "nois"),
        ({"faults": [fault("lidar", (0, 1), missing=3)]}, "missing"),
        ({"faults": [fault("sonar", (0, 1), noise=3)]}, "sonar|color_camera"),
        ({"faults": [fault("lidar", (2, 1), noise=3)]}, "earlier to a later"),
        ({"kidnaps": [{"at": 1, "ahead": 1.5}]}, "ahead"),
        ({"lighting": [{"span": [0, 1], "level": -1}]}, "level"),
    ],
)
def test_wrong_events_are_named(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        SimulatedRobot(**params)
