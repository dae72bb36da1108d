"""Sensor models of the simulator: noise as stated, geometry exact without it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import made_robot
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_robot import OFF

from dataflow.messages import Message
from dataflow.messages.geometry import invert, transform_matrix, transform_points
from operators.simulator import SimulatedRobot
from operators.simulator.rendering.optics import View
from operators.simulator.scene import Builder, Light, World
from operators.simulator.sensors import color, depth, radar
from operators.simulator.sensors.color import NoisePool
from operators.simulator.sensors.frames import BODY_TO_OPTICAL, mounted
from operators.simulator.sensors.gnss import geodetic
from operators.simulator.sensors.schedule import merged, ticks
from operators.simulator.sensors.wheels import WheelModel
from operators.simulator.settings import DepthCamera, Radar, Wheels
from operators.simulator.shapes import Array, Material, box, pose
from operators.simulator.stage import Stage
from operators.simulator.trajectory import Trajectory

POOL = NoisePool(0)
SQUARE = np.array([(0, 0), (4, 0), (4, 4), (0, 4)], float)


def robot(**params: Any) -> SimulatedRobot:
    return made_robot.robot(**{**OFF, "seed": 4, **params})


def stream(source: SimulatedRobot, port: str) -> list[Message]:
    return [step[port] for step in source.stream() if port in step]


def flat_view(z: float, cosine: float = 1.0, shape: tuple[int, int] = (120, 160)) -> View:
    full = np.full(shape, z, np.float32)
    zeros = np.zeros(shape, np.int32)
    return View(full, np.full(shape, cosine, np.float32), zeros, zeros.astype(np.uint16), zeros.astype(np.uint8), None)


@pytest.mark.parametrize("grain", [1, 2, 3, 4, 7, 16])
@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_depth_noise_is_as_large_as_stated_whatever_its_grain(z: float, grain: int) -> None:
    camera = DepthCamera(noise=0.004, quantum=0.0002, grain=grain, specks=0, edge_holes=0)
    inverse = [
        1 / depth.metres(depth.measure(flat_view(z), camera, POOL, np.random.default_rng(k)), camera.quantum)
        for k in range(120)
    ]
    assert np.mean(inverse) == pytest.approx(1 / z, rel=0.01)
    assert np.std(inverse) == pytest.approx(0.004, rel=0.02)


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


@pytest.mark.long
def test_lidar_points_lie_on_surfaces_and_noise_is_along_the_beam() -> None:
    settings_ = {"rate": 1, "rings": 8, "columns": 90, "missing": 0, "resolution": 0}
    exact, noisy = (
        stream(robot(duration="1s", lidar={**settings_, "noise": noise}), "points")[0] for noise in (0.0, 0.05)
    )
    source = robot(duration="1s", lidar=settings_)
    T = source._stage.T_world_base(0.0) @ mounted(source.lidar.mount)
    points = exact.points.astype(np.float64)
    beyond = transform_points(T, points * 1.02) - T[:3, 3]
    short = transform_points(T, points * 0.98) - T[:3, 3]
    origin = np.broadcast_to(T[:3, 3], beyond.shape)
    renderer = source._stage.at(0.0)
    assert renderer.blocked(np.concatenate([origin, beyond], axis=1).astype(np.float32)).all()
    assert not renderer.blocked(np.concatenate([origin, short], axis=1).astype(np.float32)).any()
    error = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(exact.points, axis=1)
    assert error.std() == pytest.approx(0.05, rel=0.15)
    angle = np.abs(np.cross(noisy.points, exact.points)).max()
    assert angle < 1e-3


@pytest.mark.long
def test_lidar_and_depth_camera_measure_the_same_surfaces() -> None:
    source = robot(
        duration="100ms",
        depth_camera={"rate": 10, "width": 320, "height": 240, "noise": 0, "specks": 0, "quantum": 0.00011},
        lidar={"rate": 10, "noise": 0, "missing": 0, "resolution": 0},
    )
    (step,) = source.stream()
    depth_image: Any = step["depth"]
    cloud: Any = step["points"]
    T_base_lidar = mounted(source.lidar.mount)
    p = transform_points(invert(source._rig.T_base_depth) @ T_base_lidar, cloud.points.astype(np.float64))
    p = p[p[:, 2] > 0.3]
    info: Any = source.static_outputs()["depth_info"]
    K = info.K
    column, row = (p[:, :2] / p[:, 2:] @ K[:2, :2].T + K[:2, 2]).T.round().astype(int)
    inside = (column >= 0) & (column < 320) & (row >= 0) & (row < 240)
    z, seen = p[inside, 2], depth_image.data[row[inside], column[inside]]
    apart = np.abs(z - seen)[seen > 0] / z[seen > 0]
    assert len(apart) > 100
    # The two look from different places, so near edges one of them sees what is hidden from the other.
    assert np.mean(apart < 0.02) > 0.85


@pytest.mark.long
def test_the_stereo_pair_sees_points_at_the_disparity_of_their_depth() -> None:
    size = {"width": 320, "height": 240}
    source = robot(
        duration="100ms", movers=False, color_camera={"rate": 0, **size},
        depth_camera={"rate": 10, "noise": 0, "specks": 0, "quantum": 0.00011, "edge_holes": 0},
        stereo={"rate": 10, **size, "baseline": 0.1, "read_noise": 0, "shot_noise": 0},
    )  # fmt: skip
    (step,) = source.stream()
    left, right, z = (step[port].data.astype(np.float64) for port in ("left", "right", "depth"))
    rows, columns = np.nonzero(z > 0)
    shifted = columns - 0.85 * 320 * 0.1 / z[rows, columns]
    inside = shifted >= 0
    rows, columns, shifted = rows[inside], columns[inside], shifted[inside]
    whole = np.floor(shifted).astype(int)
    share = shifted - whole
    expected = right[rows, whole] * (1 - share) + right[rows, np.minimum(whole + 1, 319)] * share
    apart = np.abs(left[rows, columns] - expected)
    unshifted = np.abs(left[rows, columns] - right[rows, columns])
    assert np.median(apart) < 2
    assert np.median(apart) < 0.5 * np.median(unshifted)


def placed(source: SimulatedRobot) -> dict[str, Array]:
    """`T_parent_child` (4, 4) of the extrinsics by child."""
    message: Any = source.static_outputs()["extrinsics"]
    return dict(zip(message.child_frames, transform_matrix(message.translations, message.rotations), strict=True))


@pytest.mark.long
def test_the_depth_camera_can_be_turned_in_the_colour_camera() -> None:
    on = {"color_camera": {"rate": 1}, "stereo": {"rate": 1}}
    plain = placed(robot(**on, depth_camera={"rate": 1}))
    turned = placed(robot(**on, depth_camera={"rate": 1, "offset": [0.03, 0, 0.01], "rotation": [0.1, -0.2, 0.3]}))
    np.testing.assert_allclose(
        invert(plain["camera_depth_optical"]) @ turned["camera_depth_optical"],
        mounted((0.03, 0, 0.01, 0.1, -0.2, 0.3)), atol=1e-9,
    )  # fmt: skip
    np.testing.assert_allclose(
        turned["camera_depth_optical"] @ turned["camera_color_optical"], plain["stereo_left_optical"], atol=1e-9
    )


@pytest.mark.long
def test_the_stereo_pair_sees_from_its_own_mount() -> None:
    mount = (0.2, -0.1, 0.9, 0.05, 0.1, 0.4)
    size = {"width": 64, "height": 48}
    clean = {"read_noise": 0, "shot_noise": 0}
    source = robot(
        duration="100ms",
        color_camera={"rate": 10, "mount": mount, "exposure_change": 0, **size, **clean},
        stereo={"rate": 10, "color": True, "mount": mount, **size, **clean},
    )
    np.testing.assert_allclose(placed(source)["stereo_left_optical"], mounted(mount) @ BODY_TO_OPTICAL, atol=1e-9)
    step: Any = next(iter(source.stream()))
    np.testing.assert_array_equal(step["left"].data, step["image"].data)


@pytest.mark.long
def test_moving_lidar_sends_time_offsets() -> None:
    (cloud,) = stream(robot(duration="200ms", lidar={"rate": 5, "columns": 60, "rings": 2, "motion": True}), "points")
    assert cloud.time_offsets.min() >= -0.2
    assert cloud.time_offsets.max() == 0
    assert (np.diff(cloud.time_offsets) >= 0).all()


@pytest.mark.long
def test_imu_noise_has_its_density_and_the_bias_walks() -> None:
    base = {"rate": 200, "gyro_walk": 0, "accel_walk": 0, "accel_noise": 0.01}
    white = stream(robot(duration="10s", hold=20, inertial={**base, "gyro_noise": 0.002}), "imu")
    gyro = np.array([m.angular_velocity for m in white])
    force = np.array([m.linear_acceleration for m in white])
    assert gyro.std() == pytest.approx(0.002 * math.sqrt(200), rel=0.05)
    assert (force - [0, 0, 9.80665]).std() == pytest.approx(0.01 * math.sqrt(200), rel=0.05)
    walking = stream(robot(duration="10s", hold=20, inertial={**base, "gyro_noise": 0, "gyro_walk": 0.01}), "imu")
    gyro = np.array([m.angular_velocity for m in walking])
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
    np.testing.assert_allclose(exact.position[:2], expected, atol=2e-3)
    real = stream(robot(duration="10s", wheels={"rate": 50}), "wheel_odometry")[-1]
    error = np.linalg.norm(real.position[:2] - expected)
    assert 5e-3 < error < 1.0
    assert error < 5 * math.sqrt(np.trace(real.pose_covariance[:2, :2]))


@pytest.mark.long
def test_radar_sees_the_still_world_come_nearer_as_the_robot_drives() -> None:
    source = robot(
        movers=False, duration="3s",
        radar={"rate": 5, "velocity_noise": 0, "azimuth_noise": 0, "clutter": 0, "mount": [0, 0, 0.5, 0, 0, 0]},
    )  # fmt: skip
    for scan in stream(source, "radar_scan"):
        speed = source._stage.world.path.at([scan.stamp * 1e-9]).speed()[0]
        np.testing.assert_allclose(scan.velocities, -speed * np.cos(scan.azimuths), atol=0.03)


@dataclass(frozen=True)
class Coming:
    """A wall that slides towards the origin along x at 0.4 m/s."""

    def frame(self, t: float) -> Array:
        return pose(5.0 - 0.4 * t)

    def parts(self, t: float) -> Array:
        return self.frame(t)[None]


def test_radar_measures_how_fast_a_mover_comes_nearer() -> None:
    """A wall comes at 0.4 m/s to a robot that stands still: along a beam at azimuth a that is 0.4 · cos a."""
    builder = Builder()
    builder.surface("floor", box((30, 30, 0.1), Material("plain"), center=(0, 0, -5.0)))
    builder.move("robot", (box((0.2, 8, 8), Material("plain")),), Coming())
    path = Trajectory(SQUARE, hold=100)
    world = World("test", tuple(builder.things), (Light((0, 0, 2), 1.0),), 0.5, path, np.zeros((0, 3)), (0,) * 6, ())
    yaw = float(path.at([0.0]).yaw[0])
    sensor = Radar(
        rate=1, field=1.0, range_noise=0, azimuth_noise=0, velocity_noise=0, clutter=0, mount=(0, 0, 1, 0, 0, -yaw)
    )
    found = radar.scan(Stage(world, 0), sensor, 2.0, np.random.default_rng(0), 0, "radar")
    assert len(found.ranges) > 20
    np.testing.assert_allclose(found.velocities, -0.4 * np.cos(found.azimuths), atol=0.005)  # beams look up and down
    np.testing.assert_allclose(found.ranges * np.cos(found.azimuths), 5 - 0.8 - 0.1, atol=0.04)


def test_wheel_ticks_are_the_way_each_wheel_rolls() -> None:
    track, radius, per_turn = 0.4, 0.08, 2048
    source = robot(duration="8s", wheels={"rate": 50, "scale_error": 0, "slip": 0})
    path = source._stage.world.path
    times = np.linspace(0, 7.98, 40_001)
    motion = path.at(times)
    left, right = (motion.speed() + side * motion.yaw_rate * track / 2 for side in (-1, 1))
    expected = [np.trapezoid(v, times) / (2 * math.pi * radius) * per_turn for v in (left, right)]
    last: Any = stream(source, "wheel_ticks")[-1]
    np.testing.assert_allclose(last.ticks, expected, atol=1.5)
    assert last.names == ("left", "right")


def test_wheel_odometry_has_the_true_rate_from_its_first_message() -> None:
    source = robot(duration="100ms", wheels={"rate": 20, "scale_error": 0, "slip": 0})
    true = source._stage.world.path.at([0.0])
    first: Any = stream(source, "wheel_odometry")[0]
    assert true.speed()[0] > 0.2
    assert first.linear[0] == pytest.approx(true.speed()[0], rel=1e-6)
    assert first.angular[2] == pytest.approx(true.yaw_rate[0], rel=1e-6)
    np.testing.assert_array_equal(first.position, 0)


def test_the_first_wheel_rate_errs_as_later_ones_do() -> None:
    path, rates = Trajectory(SQUARE, speed=0.5), []
    for seed in range(200):
        wheels = Wheels(rate=10, scale_error=0, slip=0.02, ticks_per_turn=1 << 20)
        model = WheelModel(wheels, seed)
        rng = np.random.default_rng(seed)
        measured: list[Any] = [model.measure(wheels, path, k * 0.1, rng, k, "odom", "base")[1] for k in range(4)]
        rates.append([message.linear[0] for message in measured])
    spread = np.std(rates, axis=0)
    np.testing.assert_allclose(spread[0], spread[1:].mean(), rtol=0.2)


def test_a_wheel_with_a_bias_counts_too_much_by_that_share() -> None:
    quiet = {"rate": 10, "scale_error": 0, "slip": 0}
    ends: list[Any] = [
        stream(robot(duration="5s", wheels={**quiet, **bias}), "wheel_ticks")[-1]
        for bias in ({}, {"bias": [0.05, -0.02]})
    ]
    np.testing.assert_allclose(ends[1].ticks / ends[0].ticks, [1.05, 0.98], atol=1e-3)


@pytest.mark.long
def test_wheel_odometry_errors_are_consistent_with_the_covariance() -> None:
    """Over many seeds, after rounds in which the constant scale errors add up, against wheels without error."""

    path, steps = Trajectory(SQUARE, speed=0.6), 51
    fine: dict[str, Any] = {"rate": 2, "ticks_per_turn": 1 << 20}

    def end(wheels: Wheels, seed: int) -> tuple[Array, Array]:
        """Where the wheels say that they are after 25 s, and the covariance."""
        model, rng = WheelModel(wheels, seed), np.random.default_rng(seed)
        odometry = [model.measure(wheels, path, k * 0.5, rng, k, "odom", "base")[1] for k in range(steps)][-1]
        assert odometry.pose_covariance is not None
        yaw = 2 * math.atan2(odometry.orientation[2], odometry.orientation[3])
        return np.array([*odometry.position[:2], yaw]), odometry.pose_covariance[np.ix_([0, 1, 5], [0, 1, 5])]

    exact, _ = end(Wheels(**fine, scale_error=0, slip=0), 0)

    def errors(wheels: Wheels) -> list[tuple[Array, Array]]:
        found = [end(wheels, seed) for seed in range(50)]
        turn = [0, 0, 2 * math.pi]
        return [
            (e - turn * np.round(e / (2 * math.pi)), covariance) for where, covariance in found for e in [where - exact]
        ]

    yaws = [(error[2], math.sqrt(covariance[2, 2])) for error, covariance in errors(Wheels(**fine))]
    assert np.std([yaw for yaw, _ in yaws]) == pytest.approx(np.mean([claimed for _, claimed in yaws]), rel=0.3)
    small = errors(Wheels(**fine, scale_error=0.001, slip=0.002))  # so small that they are linear in their causes
    assert 0.7 < np.mean([error @ np.linalg.solve(covariance, error) / 3 for error, covariance in small]) < 1.4


def test_wheel_errors_are_as_large_as_stated() -> None:
    """Slip over many seeds: its standard deviation grows with the square root of the way."""
    ends, path = [], Trajectory(SQUARE, speed=0.5)
    for seed in range(60):
        wheels = Wheels(rate=5, scale_error=0, slip=0.02, ticks_per_turn=1 << 20)
        model = WheelModel(wheels, seed)
        rng = np.random.default_rng(seed)
        for k in range(20):
            ticks, _ = model.measure(wheels, path, k * 0.2, rng, k, "odom", "base")
        ends.append(ticks.ticks / (1 << 20) * 2 * math.pi * 0.08)
    way = np.mean(ends, axis=0)
    np.testing.assert_allclose(np.std(ends, axis=0), 0.02 * np.sqrt(way), rtol=0.3)


@pytest.mark.long
def test_sightings_scatter_as_their_covariances_say() -> None:
    quiet = {"rate": 20, "missing": 0, "max_range": 20}
    noisy, exact = (
        stream(robot(duration="2s", movers=False, hold=10, landmarks={**quiet, **noise}), "sightings")
        for noise in ({}, {"range_noise": 0, "bearing_noise": 0})
    )
    pulls = []
    for m, truth in zip(noisy, exact, strict=True):
        n, t = cast(Any, m), cast(Any, truth)
        error = np.stack([n.ranges - t.ranges, n.bearings - t.bearings, n.elevations - t.elevations], axis=1)
        pulls.append(error / np.sqrt(np.diagonal(n.covariances, axis1=1, axis2=2)))
    np.testing.assert_allclose(np.concatenate(pulls).std(axis=0), 1, rtol=0.15)


@pytest.mark.long
def test_a_camera_sights_landmarks_by_the_same_bearings_without_ranges() -> None:
    given = {"rate": 5, "max_range": 20}
    (both, *_), (bearings, *_) = (
        stream(robot(duration="400ms", movers=False, landmarks={**given, **kind}), "sightings")
        for kind in ({}, {"ranges": False, "frame": "eye"})
    )
    b, c = cast(Any, both), cast(Any, bearings)
    assert (c.ranges, c.frame) == (None, "eye")
    np.testing.assert_array_equal(c.bearings, b.bearings)
    np.testing.assert_array_equal(c.elevations, b.elevations)
    np.testing.assert_array_equal(c.covariances, b.covariances[:, 1:, 1:])


@pytest.mark.long
def test_a_landmark_behind_something_is_not_sighted() -> None:
    source = robot(duration="100ms", movers=False, landmarks={"rate": 10, "missing": 0, "max_range": 100})
    (message,) = stream(source, "sightings")
    T = source._stage.T_world_base(0.0) @ mounted(source.landmarks.mount)
    places = source._stage.world.landmarks
    rays = np.concatenate([np.broadcast_to(T[:3, 3], places.shape), places - T[:3, 3]], axis=1).astype(np.float32)
    free = source._stage.at(0.0).cast(rays).distance * np.linalg.norm(places - T[:3, 3], axis=1)
    way = np.linalg.norm(places - T[:3, 3], axis=1)
    ids: Any = message
    np.testing.assert_array_equal(np.sort(ids.ids), np.flatnonzero(free > way - 0.06))


def test_landmark_sightings_agree_with_the_map() -> None:
    source = robot(
        duration="2s", landmarks={"rate": 2, "range_noise": 0, "bearing_noise": 0, "missing": 0, "max_range": 20}
    )
    places = source.static_outputs()["landmark_map"].positions
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


@pytest.mark.long
def test_satellite_fixes_scatter_about_the_antenna() -> None:
    fixes: list[Any] = stream(robot(duration="20s", hold=30, gnss={"rate": 20, "noise": 0.5, "drift": 0}), "fix")
    north = np.array([fix.latitude for fix in fixes])
    assert np.std(north) * 111_200 == pytest.approx(0.5, rel=0.15)
    assert np.std([fix.altitude for fix in fixes]) == pytest.approx(1.0, rel=0.15)


@pytest.mark.long
def test_satellites_are_lost_under_a_roof() -> None:
    source = robot(world="yard", duration="82s", movers=False, gnss={"rate": 2, "sky": True, "drift": 0, "noise": 0.1})
    fixes: list[Any] = stream(source, "fix")
    assert len(fixes) > 60
    stage, open_sky = source._stage, {}
    for k in range(164):
        antenna = (stage.T_world_base(k / 2) @ mounted(source.gnss.mount))[:3, 3]
        up = np.concatenate([antenna, [0, 0, 20.0]])[None].astype(np.float32)
        open_sky[k * 500_000_000] = not stage.at(k / 2).blocked(up)[0]
    seen = {fix.stamp: fix for fix in fixes}
    under = [stamp for stamp, free in open_sky.items() if not free]
    assert len(under) > 40
    assert sum(stamp in seen for stamp in under) < 0.2 * len(under)
    assert all(stamp in seen for stamp, free in open_sky.items() if free)
    assert all(fix.satellites >= 4 for fix in fixes)
    few, many = (
        [np.trace(fix.covariance) for fix in fixes if low <= fix.satellites < high] for low, high in ((4, 8), (11, 13))
    )
    assert min(few) > max(many)


def test_a_mount_turns_about_fixed_axes() -> None:
    T = mounted((1.0, 2.0, 3.0, 0.0, math.pi / 2, 0.0)) @ BODY_TO_OPTICAL
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-12)  # pitch > 0 looks down
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])


def test_a_magnetometer_points_north_and_down() -> None:
    sensor = {"rate": 10, "noise": 0, "declination": 0.0, "mount": [0, 0, 1, 0.1, -0.2, 0.7]}
    source = robot(duration="2s", magnetometer=sensor)
    for message in stream(source, "magnetic_field"):
        m: Any = message
        T = source._stage.T_world_base(m.stamp * 1e-9) @ mounted(source.magnetometer.mount)
        field = T[:3, :3] @ m.field
        assert math.atan2(field[0], field[1]) == pytest.approx(0, abs=1e-9)  # y is north
        assert math.atan2(-field[2], np.hypot(*field[:2])) == pytest.approx(source.magnetometer.inclination)
        assert np.linalg.norm(field) == pytest.approx(source.magnetometer.strength)


def test_iron_bends_the_field_of_a_magnetometer() -> None:
    base = {"rate": 10, "noise": 0}
    plain, iron, bent, noisy = (
        np.array([m.field for m in stream(robot(duration="20s", magnetometer={**base, **more}), "magnetic_field")])
        for more in ({}, {"hard_iron": [1e-6, 2e-6, 0], "soft_iron": 0.1}, {"disturbance": 3e-6}, {"noise": 1e-6})
    )
    np.testing.assert_allclose(iron, plain * [1.1, 1, 1] + [1e-6, 2e-6, 0], atol=1e-12)
    assert 1e-6 < (bent - plain).std() < 6e-6
    assert np.abs(np.diff(bent - plain, axis=0)).max() < 1e-6  # it changes over metres
    assert (noisy - plain).std() == pytest.approx(1e-6, rel=0.1)
