"""Sensor models of the simulator: noise as stated, geometry exact without it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import Message
from dataflow.messages.geometry import transform_points
from operators.sources import SimulatedRobot
from operators.sources.simulator import color, depth
from operators.sources.simulator.frames import BODY_TO_OPTICAL, mounted
from operators.sources.simulator.gnss import geodetic
from operators.sources.simulator.noise import NoisePool
from operators.sources.simulator.renderer import View
from operators.sources.simulator.schedule import merged, ticks
from operators.sources.simulator.settings import DepthCamera

OFF: dict[str, Any] = {
    "color_camera": {"rate": 0},
    "depth_camera": {"rate": 0},
    "truth": {"poses": 0, "boxes": False, "relations": 0, "activities": 0},
}
POOL = NoisePool(0)


def robot(**params: Any) -> SimulatedRobot:
    made = SimulatedRobot(**{**OFF, "seed": 4, **params})
    made.setup()
    return made


def stream(source: SimulatedRobot, port: str) -> list[Message]:
    return [step[port] for step in source.stream() if port in step]


def flat_view(z: float, cosine: float = 1.0, shape: tuple[int, int] = (120, 160)) -> View:
    full = np.full(shape, z, np.float32)
    zeros = np.zeros(shape, np.int32)
    return View(full, np.full(shape, cosine, np.float32), zeros, zeros.astype(np.uint16), zeros.astype(np.uint8), None)


@pytest.mark.parametrize("grain", [1, 4])
@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_depth_noise_grows_with_the_square_of_depth(z: float, grain: int) -> None:
    camera = DepthCamera(noise=0.004, quantum=0.0002, grain=grain, specks=0)
    levels = depth.measure(flat_view(z), camera, POOL, np.random.default_rng(1))
    metres = depth.metres(levels, camera.quantum)
    assert metres.mean() == pytest.approx(z, rel=0.01)
    assert metres.std() == pytest.approx(0.004 * z * z, rel=0.15)


def test_depth_is_quantised_in_steps_of_inverse_depth() -> None:
    camera = DepthCamera(noise=0, quantum=0.01, specks=0, edge_holes=0)
    (value,) = np.unique(depth.metres(depth.measure(flat_view(2.0041), camera, POOL, np.random.default_rng(0)), 0.01))
    assert value == np.float32(1 / (50 * 0.01))


@pytest.mark.parametrize(
    ("z", "cosine"),
    [(0.1, 1.0), (9.0, 1.0), (math.inf, 1.0), (2.0, 0.05)],  # too near, too far, nothing there, grazing
)
def test_depth_has_no_return_where_the_camera_cannot_measure(z: float, cosine: float) -> None:
    assert not depth.measure(flat_view(z, cosine), DepthCamera(), POOL, np.random.default_rng(0)).any()


def test_depth_has_holes_along_edges_only() -> None:
    view = flat_view(2.0)
    view.depth[:, 80:] = 3.0
    levels = depth.measure(view, DepthCamera(edge_holes=1.0, specks=0), POOL, np.random.default_rng(0))
    assert set(np.nonzero(levels == 0)[1]) == {79, 80}


def test_bias_lengthens_depths() -> None:
    camera = DepthCamera(noise=0, specks=0, quantum=0.0002, bias=0.1)
    levels = depth.measure(flat_view(2.0), camera, POOL, np.random.default_rng(0))
    assert depth.metres(levels, camera.quantum).mean() == pytest.approx(2.2, rel=1e-3)


@pytest.mark.parametrize("brightness", [20.0, 120.0])
def test_image_noise_has_its_two_parts(brightness: float) -> None:
    image = np.full((100, 120, 3), brightness, np.float32)
    pixels = color.develop(image, POOL, np.random.default_rng(0), 2.0, 0.3)
    assert pixels.mean() == pytest.approx(brightness, abs=0.2)
    assert pixels.std() == pytest.approx(math.sqrt(4 + 0.09 * brightness + 1 / 12), rel=0.04)


def test_blur_moves_nothing_and_smears_along_the_shift() -> None:
    dot = np.zeros((21, 21, 3), np.float32)
    dot[10, 10] = 100
    smeared = color.blur(dot, (6.0, 0.0))
    assert smeared.sum() == pytest.approx(300, rel=1e-3)
    rows, columns = np.nonzero(smeared[..., 0])
    assert set(rows) == {10}
    assert columns.mean() == pytest.approx(10)
    assert len(columns) >= 6


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(0.5, 50), st.integers(0, 10**9)), min_size=1, max_size=5))
def test_merged_ticks_are_all_ticks_in_order(sensors: list[tuple[float, int]]) -> None:
    end = 2 * 10**9
    streams = {str(k): ticks(str(k), rate, phase, end) for k, (rate, phase) in enumerate(sensors)}
    found = list(merged(streams))
    stamps = [stamp for stamp, _ in found]
    assert stamps == sorted(set(stamps))
    single = [tick for k, (rate, phase) in enumerate(sensors) for tick in ticks(str(k), rate, phase, end)]
    assert sorted(single, key=lambda t: (t.stamp, t.sensor)) == [tick for _, group in found for tick in group]


def test_lidar_points_lie_on_what_is_there_and_noise_is_along_the_beam() -> None:
    settings_ = {"rate": 1, "rings": 8, "columns": 90, "missing": 0, "resolution": 0}
    exact, noisy = (
        stream(robot(duration="1s", lidar={**settings_, "noise": noise}), "points")[0] for noise in (0.0, 0.05)
    )
    source = robot(duration="1s", lidar=settings_)
    T = source._stage.T_world_base(0.0) @ mounted(source.lidar.mount)
    points = exact.points.astype(np.float64)  # type: ignore[attr-defined]
    beyond = transform_points(T, points * 1.02) - T[:3, 3]
    short = transform_points(T, points * 0.98) - T[:3, 3]
    origin = np.broadcast_to(T[:3, 3], beyond.shape)
    renderer = source._stage.at(0.0)
    assert renderer.blocked(np.concatenate([origin, beyond], axis=1).astype(np.float32)).all()
    assert not renderer.blocked(np.concatenate([origin, short], axis=1).astype(np.float32)).any()
    error = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(exact.points, axis=1)  # type: ignore[attr-defined]
    assert error.std() == pytest.approx(0.05, rel=0.15)
    angle = np.abs(np.cross(noisy.points, exact.points)).max()  # type: ignore[attr-defined]
    assert angle < 1e-3


def test_a_moving_lidar_says_when_it_measured() -> None:
    (cloud,) = stream(robot(duration="200ms", lidar={"rate": 5, "columns": 60, "rings": 2, "motion": True}), "points")
    assert cloud.time_offsets.min() >= -0.2  # type: ignore[attr-defined]
    assert cloud.time_offsets.max() == 0  # type: ignore[attr-defined]
    assert (np.diff(cloud.time_offsets) >= 0).all()  # type: ignore[attr-defined]


def test_imu_noise_has_its_density_and_the_bias_walks() -> None:
    base = {"rate": 200, "gyro_walk": 0, "accel_walk": 0, "accel_noise": 0.01}
    white = stream(robot(duration="10s", hold=20, inertial={**base, "gyro_noise": 0.002}), "imu")
    gyro = np.array([m.angular_velocity for m in white])  # type: ignore[attr-defined]
    force = np.array([m.linear_acceleration for m in white])  # type: ignore[attr-defined]
    assert gyro.std() == pytest.approx(0.002 * math.sqrt(200), rel=0.05)
    assert (force - [0, 0, 9.80665]).std() == pytest.approx(0.01 * math.sqrt(200), rel=0.05)
    walking = stream(robot(duration="10s", hold=20, inertial={**base, "gyro_noise": 0, "gyro_walk": 0.01}), "imu")
    gyro = np.array([m.angular_velocity for m in walking])  # type: ignore[attr-defined]
    assert np.diff(gyro, axis=0).std() == pytest.approx(0.01 / math.sqrt(200), rel=0.1)


def test_wheels_without_error_follow_the_path_and_with_it_drift() -> None:
    perfect = {"rate": 50, "scale_error": 0, "slip": 0, "ticks_per_turn": 65536}
    source = robot(duration="10s", wheels=perfect)
    path = source._stage.world.path
    first, last = path.at([0.0]), path.at([9.98])
    offset = last.position[0] - first.position[0]
    c, s = math.cos(first.yaw[0]), math.sin(first.yaw[0])
    expected = np.array([c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1]])
    exact = stream(source, "wheel_odometry")[-1]
    np.testing.assert_allclose(exact.position[:2], expected, atol=2e-3)  # type: ignore[attr-defined]
    real = stream(robot(duration="10s", wheels={"rate": 50}), "wheel_odometry")[-1]
    error = np.linalg.norm(real.position[:2] - expected)  # type: ignore[attr-defined]
    assert 5e-3 < error < 1.0
    assert error < 5 * math.sqrt(np.trace(real.pose_covariance[:2, :2]))  # type: ignore[attr-defined]


def test_radar_sees_the_still_world_come_nearer_as_the_robot_drives() -> None:
    source = robot(
        movers=False, duration="3s",
        radar={"rate": 5, "velocity_noise": 0, "azimuth_noise": 0, "clutter": 0, "mount": [0, 0, 0.5, 0, 0, 0]},
    )  # fmt: skip
    for scan in stream(source, "radar_scan"):
        speed = source._stage.world.path.at([scan.stamp * 1e-9]).speed()[0]
        np.testing.assert_allclose(scan.velocities, -speed * np.cos(scan.azimuths), atol=0.03)  # type: ignore[attr-defined]


def test_landmarks_are_where_the_map_says() -> None:
    source = robot(
        duration="2s", landmarks={"rate": 2, "range_noise": 0, "bearing_noise": 0, "missing": 0, "max_range": 20}
    )
    places = source.static_outputs()["landmark_map"].positions  # type: ignore[attr-defined]
    for message in stream(source, "sightings"):
        T = source._stage.T_world_base(message.stamp * 1e-9) @ mounted(source.landmarks.mount)
        m: Any = message
        assert len(m.ids) > 2
        flat = m.ranges * np.cos(m.elevations)
        p = np.stack([flat * np.cos(m.bearings), flat * np.sin(m.bearings), m.ranges * np.sin(m.elevations)], axis=1)
        np.testing.assert_allclose(transform_points(T, p), places[m.ids], atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(*[st.floats(-5000, 5000)] * 3), st.floats(-80, 80), st.floats(-179, 179), st.floats(-100, 3000)
)  # fmt: skip
def test_geodetic_coordinates_return_to_the_same_place(
    enu: tuple[float, float, float], latitude: float, longitude: float, altitude: float
) -> None:
    def ecef(lat: float, lon: float, h: float) -> np.ndarray:
        a, e2 = 6378137.0, 0.0066943799901413165
        lat, lon = math.radians(lat), math.radians(lon)
        n = a / math.sqrt(1 - e2 * math.sin(lat) ** 2)
        return np.array(
            [
                (n + h) * math.cos(lat) * math.cos(lon),
                (n + h) * math.cos(lat) * math.sin(lon),
                (n * (1 - e2) + h) * math.sin(lat),
            ]
        )

    found = ecef(*geodetic(np.array(enu), latitude, longitude, altitude))
    lat, lon = math.radians(latitude), math.radians(longitude)
    east = np.array([-math.sin(lon), math.cos(lon), 0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    offset = found - ecef(latitude, longitude, altitude)
    np.testing.assert_allclose([offset @ east, offset @ np.cross(up, east), offset @ up], enu, atol=1e-5)


def test_satellite_fixes_scatter_about_the_antenna() -> None:
    fixes: list[Any] = stream(robot(duration="20s", hold=30, gnss={"rate": 20, "noise": 0.5, "drift": 0}), "fix")
    north = np.array([fix.latitude for fix in fixes])
    assert np.std(north) * 111_200 == pytest.approx(0.5, rel=0.15)
    assert np.std([fix.altitude for fix in fixes]) == pytest.approx(1.0, rel=0.15)


def test_a_mount_turns_about_fixed_axes() -> None:
    T = mounted((1.0, 2.0, 3.0, 0.0, math.pi / 2, 0.0)) @ BODY_TO_OPTICAL
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-12)  # pitch > 0 looks down
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
