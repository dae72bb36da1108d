"""The simulated robot as a source: determinism, stamps, faults, and what is switched on and off."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import made_robot
import numpy as np
import pytest
from made_robot import OFF, QUIET, SMALL, run

from dataflow.messages import CompressedDepth, CompressedImage, Image, Message
from dataflow.operator import ParameterError
from operators.codec import DepthDecoder, ImageDecoder
from operators.simulator import SimulatedRobot

EVERYTHING: dict[str, Any] = {
    "seed": 5,
    "duration": "600ms",
    "color_camera": {**SMALL, "output": "both"},
    "depth_camera": {"output": "both"},
    "stereo": {"rate": 5, **SMALL},
    "lidar": {"rate": 5, "rings": 4, "columns": 60, "motion": True},
    "inertial": {"rate": 100},
    "magnetometer": {"rate": 50, "disturbance": 2e-6},
    "wheels": {"rate": 20},
    "radar": {"rate": 5},
    "landmarks": {"rate": 5},
    "gnss": {"rate": 2},
    "motion": {"bumps": 0.002, "sway": 0.01, "turn": 0.02},
    "faults": [{"sensor": "lidar", "span": [0.3, 0.5], "set": {"noise": 0.1}}],
    "truth": {"masks": True, "occupancy": True, "surfaces": True, "mesh": True, "events": True},
}


def digest(streams: dict[str, list[Message]]) -> str:
    total = hashlib.sha256()
    for port in sorted(streams):
        total.update(port.encode() + b"".join(m.digest() for m in streams[port]))
    return total.hexdigest()


def camera_only(**params: Any) -> dict[str, list[Message]]:
    return run(**{"truth": QUIET, "depth_camera": {"rate": 0}, "movers": False, "duration": "1s", **params})


@pytest.fixture(scope="module")
def everything() -> dict[str, list[Message]]:
    return run(**EVERYTHING)


@pytest.mark.long
def test_every_declared_port_is_fed_when_everything_is_on(everything: dict[str, list[Message]]) -> None:
    assert set(everything) == set(SimulatedRobot.spec.outputs)


@pytest.mark.long
def test_fresh_processes_make_the_same_bytes_with_one_thread_and_with_two(everything: dict[str, list[Message]]) -> None:
    def started(threads: int, hash_seed: str) -> subprocess.Popen[str]:
        program = (
            f"import sys; sys.path[:0] = {[str(Path(p).parent) for p in (__file__, made_robot.__file__)]!r}\n"
            "from test_robot import EVERYTHING, digest, run\n"
            f"print(digest(run(**EVERYTHING, threads={threads})))"
        )
        return subprocess.Popen(
            [sys.executable, "-c", program],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            stdout=subprocess.PIPE,
            text=True,
        )

    processes = [started(1, "1"), started(2, "2")]
    answers = [process.communicate(timeout=100)[0].split()[-1] for process in processes]
    assert answers == [digest(everything)] * 2


@pytest.mark.long
def test_a_robot_set_up_twice_makes_the_same_bytes_again() -> None:
    robot = SimulatedRobot(**{**EVERYTHING, "duration": "200ms"})
    digests = []
    for _ in range(2):
        robot.setup()
        digests.append([m.digest() for step in robot.stream() for m in step.values()])
    assert digests[0] == digests[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("sensor", "ports"),
    [
        ("depth_camera", {"depth", "depth_png"}),
        ("stereo", {"left", "right"}),
        ("lidar", {"points"}),
        ("inertial", {"imu"}),
        ("magnetometer", {"magnetic_field"}),
        ("wheels", {"wheel_ticks", "wheel_odometry"}),
        ("radar", {"radar_scan"}),
        ("landmarks", {"sightings"}),
        ("gnss", {"fix"}),
        ("truth", {"ground_truth", "true_base", "activities", "scene"}),
        ("color_camera", {"image", "image_jpeg"}),
    ],
)
def test_a_sensor_measures_the_same_alone_and_beside_all_others(
    sensor: str, ports: set[str], everything: dict[str, list[Message]]
) -> None:
    shared = {name: EVERYTHING[name] for name in ("seed", "duration", "motion", "faults")}
    seen = {"truth": {**QUIET, "boxes": True, "masks": True}} if sensor == "color_camera" else {}
    alone = run(**{**OFF, **shared, **seen, sensor: EVERYTHING[sensor]})
    for port in {*ports, *(("objects", "boxes", "masks") if seen else ())}:
        assert alone[port] == everything[port], port


@pytest.mark.long
def test_a_sensor_that_is_off_has_no_messages_and_no_frame() -> None:
    streams = camera_only(color_camera=SMALL)
    assert set(streams) == {"image", "image_info", "extrinsics"}
    assert set(streams["extrinsics"][0].child_frames) == {"camera_depth_optical", "camera_color_optical"}


@pytest.mark.long
def test_stamps_lie_on_each_sensors_grid_and_strictly_increase() -> None:
    robot = SimulatedRobot(
        duration="1s",
        first_stamp=1000,
        color_camera={"rate": 3, **SMALL},
        depth_camera={"rate": 0},
        inertial={"rate": 7, "phase": "10ms"},
        truth=QUIET,
        movers=False,
    )
    robot.setup()
    steps = [dict(step) for step in robot.stream()]
    stamps = [next(iter(step.values())).stamp for step in steps]
    assert stamps == sorted(set(stamps))
    assert [m["image"].stamp for m in steps if "image" in m] == [1000, 333334333, 666667666]
    assert [m["imu"].stamp for m in steps if "imu" in m][:3] == [10001000, 152858142, 295715285]
    assert robot.length() == len(steps)


def test_compressed_streams_decode_to_the_raw_ones(everything: dict[str, list[Message]]) -> None:
    for raw, packed in zip(everything["depth"], everything["depth_png"], strict=True):
        assert isinstance(packed, CompressedDepth)
        assert DepthDecoder().decode(packed) == raw
    for raw, packed in zip(everything["image"], everything["image_jpeg"], strict=True):
        assert isinstance(raw, Image)
        assert isinstance(packed, CompressedImage)
        decoded = ImageDecoder().decode(packed)
        assert np.abs(decoded.data.astype(int) - raw.data).mean() < 8


@pytest.mark.long
def test_dropout_loses_its_share_and_outages_all_but_not_the_truth() -> None:
    lossy = run(
        duration="20s", color_camera={"rate": 0}, depth_camera={"rate": 0}, truth=QUIET, movers=False,
        inertial={"rate": 100, "dropout": 0.3, "outages": [(5.0, 6.0)]},
    )["imu"]  # fmt: skip
    seconds = np.array([m.stamp for m in lossy]) * 1e-9
    assert not ((seconds >= 5) & (seconds < 6)).any()
    assert abs(len(lossy) / 1900 - 0.7) < 0.04
    assert len({m.stamp for m in lossy}) == len(lossy)
    blind = run(duration="500ms", color_camera={**SMALL, "dropout": 1.0}, depth_camera={"rate": 0})
    assert "image" not in blind
    assert len(blind["objects"]) == 5


@pytest.mark.long
def test_delay_of_the_inertial_unit_shifts_its_measurements() -> None:
    quiet = {"rate": 100, "gyro_noise": 0, "gyro_walk": 0, "accel_noise": 0, "accel_walk": 0}
    sharp, late = (
        run(**{**OFF, "movers": False, "duration": "3s", "inertial": {**quiet, "delay": delay}})["imu"]
        for delay in (0, "50ms")
    )
    turning = np.array([m.angular_velocity[2] for m in sharp])
    delayed = np.array([m.angular_velocity[2] for m in late])
    np.testing.assert_allclose(delayed[5:], turning[:-5], atol=1e-9)
    assert np.abs(delayed - turning).max() > 1e-3


@pytest.mark.long
def test_black_depth_frames_have_no_return_and_black_pairs_no_light() -> None:
    dark = run(
        duration="400ms", movers=False, color_camera={"rate": 0, **SMALL}, truth=QUIET,
        depth_camera={"rate": 5, "black": 1.0}, stereo={"rate": 5, **SMALL, "black": 1.0},
    )  # fmt: skip
    assert not any(m.data.any() for m in dark["depth"])
    assert all(m.data.mean() < 5 for port in ("left", "right") for m in dark[port])


@pytest.mark.long
def test_seeds_make_different_worlds() -> None:
    first, second = (camera_only(seed=seed, duration="100ms", color_camera=SMALL)["image"][0] for seed in (0, 1))
    assert np.abs(first.data.astype(int) - second.data).mean() > 10


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"world": "moon"}, "world"),
        ({"lidar": {"ring": 3}}, "lidar.ring"),
        ({"color_camera": {"rate": -1}}, "color_camera.rate"),
        ({"speed": 3.0}, "speed"),
    ],
)
def test_wrong_parameters_are_named(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        SimulatedRobot(**params)


def test_one_frame_for_two_cameras_is_refused() -> None:
    with pytest.raises(ValueError, match="must differ"):
        SimulatedRobot(image_frame="a", depth_frame="a").setup()
