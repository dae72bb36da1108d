"""Localisation by particles: finds the robot, finds it again, heeds who fits, and names what it cannot use."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_room import Drive, mounts, room
from operator_runs import assert_resumes_alike

from dataflow.messages import Boxes3D, LandmarkSightings, LaserScan, NavSatFix, PointCloud, Pose
from dataflow.messages.geometry import quaternion_from_yaw, yaw_of
from dataflow.testing import Played, play
from operators.localization import ParticleFilterLocalizer
from operators.localization.map_file import read_map, write_map


def localized(
    drive: Drive, sensors: dict[str, Any], given: dict[str, Any] | None = None, **params: Any
) -> tuple[Played, ParticleFilterLocalizer]:
    """Plays a drive's odometry and sensors with its maps, or with others `given` in their place."""
    operator = ParticleFilterLocalizer(**{"modality_particles": 0, **params})
    maps = {"map": [drive.grid], "landmark_map": [drive.landmark_map()], "extrinsics": [mounts()], **(given or {})}
    static = [name for name in maps if name != "odometry"]
    streams = {"odometry": drive.odometry(), "measurements": sensors, **maps}
    return play(operator, streams, static=static, paranoid=False), operator


def chairs(centers: Any, stamp: int, frame: str) -> Boxes3D:
    n = len(centers)
    return Boxes3D(
        stamp=stamp,
        frame=frame,
        class_names=("chair",),
        centers=np.array(centers, np.float64),
        sizes=np.full((n, 3), 0.5),
        orientations=np.tile([0.0, 0, 0, 1], (n, 1)),
        scores=np.ones(n, np.float32),
        class_ids=np.zeros(n, np.int32),
    )


def errors(drive: Drive, poses: list[Any], since: float = 1.0) -> tuple[float, float, int]:
    """Largest error in metres and degrees from a time on (s), and the number of poses from then on."""
    off = []
    for pose in poses:
        true = drive.pose(pose.stamp * 1e-9)
        turn = (float(yaw_of(pose.orientation)) - true[2] + math.pi) % (2 * math.pi) - math.pi
        if pose.stamp * 1e-9 >= since:
            off.append((float(np.hypot(*(pose.position[:2] - true[:2]))), abs(math.degrees(turn))))
    far, turned = np.max(off, axis=0)
    return float(far), float(turned), len(off)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_scan_finds_the_robot_anywhere_in_the_map(seed: int) -> None:
    drive = Drive(5.0, seed)
    played, _ = localized(drive, {"scan": drive.scans()})
    far, turned, count = errors(drive, played["pose"])
    assert far < 0.1
    assert turned < 2.0
    assert count >= 79


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_robot_that_was_carried_away_is_found_again(seed: int) -> None:
    drive = Drive(6.0, seed, carried=(3.0, 0.45))
    played, operator = localized(drive, {"scan": drive.scans()})
    assert errors(drive, [p for p in played["pose"] if p.stamp < 3e9])[0] < 0.1
    far, turned, count = errors(drive, played["pose"], since=5.0)
    assert far < 0.1
    assert turned < 2.0
    assert count == 20
    assert operator.summary()["particles injected"] > 0


@pytest.mark.long
def test_landmarks_without_identity_and_positions_localize_too() -> None:
    drive = Drive(5.0)
    sensors = {"seen": drive.sightings(known=False), "place": drive.positions()}
    played, _ = localized(drive, sensors, modality_particles=300)
    assert errors(drive, played["pose"], since=3.0)[:2] < (0.1, 3.0)
    assert errors(drive, played["position_pose"], since=4.0)[0] < 0.2


@pytest.mark.long
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("known", [True, False])
def test_a_landmark_of_the_map_that_is_nowhere_is_as_if_it_were_not_in_it(wrong: float, known: bool) -> None:
    drive = Drive(3.0)
    whole = drive.landmark_map()
    positions = whole.positions.copy()
    positions[0] = wrong
    sensors = {"scan": drive.scans(), "seen": drive.sightings(known=known)}
    played, _ = localized(drive, sensors, {"landmark_map": [whole.replace(positions=positions)]})
    assert errors(drive, played["pose"], since=2.0)[0] < 0.1


def test_the_robot_is_found_again_by_landmarks_alone() -> None:
    drive = Drive(6.0, carried=(3.0, 0.45))
    played, _ = localized(drive, {"seen": drive.sightings()})
    assert errors(drive, played["pose"], since=4.5)[:2] < (0.1, 3.0)


def said(played: Played, sensor: str, seconds: float) -> float:
    """What a sensor counted at a time."""
    status = next(s for s in played["status"] if s.stamp >= seconds * 1e9)
    row = next(k for k, name in enumerate(status.names) if name.endswith(sensor))
    return float(dict(status.pairs(row))["counts"])


@pytest.mark.long
@pytest.mark.parametrize("wrong", [{"turned": 0.2}, {"longer": 0.4}])
def test_a_lidar_that_degrades_loses_its_say_and_the_pose_stays_right(wrong: dict[str, float]) -> None:
    drive = Drive(8.0)
    sensors = {"scan": drive.scans(after=4.0, **wrong), "seen": drive.sightings(), "place": drive.positions()}
    played, _ = localized(drive, sensors)
    assert said(played, "scan", 3.0) == 1.0
    assert said(played, "scan", 6.0) < 0.3
    assert said(played, "seen", 6.0) == 1.0
    far, turned, count = errors(drive, played["pose"])
    assert far < 0.15
    assert turned < 4.0
    assert count > 130


@pytest.mark.long
def test_landmarks_that_degrade_lose_their_say_to_the_lidar() -> None:
    drive = Drive(7.0)
    sensors = {"scan": drive.scans(), "seen": drive.sightings(off=0.5, after=3.0)}
    played, _ = localized(drive, sensors)
    assert said(played, "seen", 5.0) < 0.1
    assert said(played, "scan", 5.0) == 1.0
    assert errors(drive, played["pose"])[0] < 0.1


@pytest.mark.long
def test_a_modality_that_contradicts_the_fused_estimate_is_named() -> None:
    drive = Drive(6.0)
    sensors = {"scan": drive.scans(turned=0.2, after=2.0), "seen": drive.sightings(), "place": drive.positions()}
    played, _ = localized(drive, sensors, modality_particles=200)
    last = played["status"][-1]
    assert dict(zip(last.names, last.messages, strict=True))["lidar alone"] == "contradicts the fused estimate"


@pytest.mark.long
def test_a_gyroscope_makes_up_for_wheels_that_slip() -> None:
    drive = Drive(8.0)
    slipping = drive.odometry(slip=0.5)
    sensors = {"place": drive.positions(), "imu": drive.gyro()}
    for turns, largest in ((sensors, 5.0), ({"place": sensors["place"]}, math.inf)):
        operator = ParticleFilterLocalizer(start=tuple(drive.pose(0.05)), modality_particles=0)
        played = play(operator, {"odometry": slipping, "measurements": turns}, paranoid=False)
        off = errors(drive, played["pose"])[1]
        assert off < largest
        disagreements = operator.summary()["turns on which wheels and gyroscope disagree"]
        assert (disagreements > 0) is ("imu" in turns)


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    drive = Drive(3.0)
    around = mounts(), drive.grid, drive.landmark_map()
    measured = [("scan", m) for m in drive.scans()] + [("seen", m) for m in drive.sightings()]
    firings: list[Any] = [(m.stamp, (None, {f"measurements/{name}": m}, *around)) for name, m in measured]
    firings += [(m.stamp, (m, {}, *around)) for m in drive.odometry()]
    firings = [given for _, given in sorted(firings, key=lambda firing: firing[0])]
    assert_resumes_alike(lambda: ParticleFilterLocalizer(modality_particles=100), firings, len(firings) // 2)


def test_the_number_of_particles_follows_the_spread() -> None:
    drive = Drive(3.0)
    played, _ = localized(drive, {"scan": drive.scans()}, min_particles=100, max_particles=800)
    assert max(cloud.count for cloud in played["particles"]) == 800
    assert played["particles"][-1].count < 250


def test_unusable_measurements_are_counted_by_reason() -> None:
    drive = Drive(1.0)
    empty = PointCloud(stamp=100_000_000, frame="base_link", points=np.full((20, 3), np.nan))
    strange = LandmarkSightings(
        stamp=200_000_000, frame="base_link", ids=[99], ranges=[1.0], bearings=[0.0], covariances=[np.eye(2) * 0.01]
    )
    _, operator = localized(drive, {"points": [empty], "seen": [strange]})
    assert operator.summary()["ignored, measurements/points: fewer than 8 points in the band"] == 1
    assert operator.summary()["ignored, measurements/seen: nothing of it is in the map"] == 1
    assert operator.summary()["poses waiting"] == 19


COVARIANCE = np.diag([0.05**2, 0.05**2, 1.0, 1.0, 1.0, 0.01])
NOWHERE = Pose(
    stamp=300_000_000, frame="world", child_frame="base_link", position=[math.nan, 0, 0], orientation=[0, 0, 0, 1]
)
NO_FIX = NavSatFix(
    stamp=300_000_000, frame="base_link", status="no_fix", latitude=math.nan, longitude=math.nan, altitude=math.nan
)
BLIND = LaserScan(
    stamp=300_000_000, frame="base_link", angle_min=0.0, angle_max=3.0, ranges=[math.inf, math.nan, 0] * 40
)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (NOWHERE.replace(covariance=COVARIANCE), "not finite"),
        (NO_FIX, "no fix"),
        (BLIND, "fewer than 8 points in the band"),
        (chairs([[1.0, 1.0, 0.5]], stamp=300_000_000, frame="base_link"), "no map of objects"),
    ],
    ids=["position", "satellites", "scan", "objects"],
)
def test_a_bad_measurement_beside_good_scans_is_counted_and_the_robot_is_followed(message: Any, reason: str) -> None:
    drive = Drive(3.0)
    played, operator = localized(drive, {"scan": drive.scans(), "bad": [message]})
    assert operator.summary()[f"ignored, measurements/bad: {reason}"] == 1
    assert errors(drive, played["pose"])[0] < 0.1


@pytest.mark.long
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
def test_an_object_of_the_map_that_is_nowhere_is_as_if_it_were_not_in_it(wrong: float) -> None:
    drive = Drive(3.0)
    places = [[2.0, 1.0, 0.5], [-2.0, 1.5, 0.5], [wrong, 0.0, 0.5]]
    seen = []
    for scan in drive.scans():
        x, y, yaw = drive.pose(scan.stamp * 1e-9)
        c, s = math.cos(yaw), math.sin(yaw)
        at = [[c * (a - x) + s * (b - y), c * (b - y) - s * (a - x), z] for a, b, z in places[:2]]
        seen.append(chairs(at, stamp=scan.stamp, frame="base_link"))
    digests = []
    for known in (places, places[:2]):
        object_map = chairs(known, stamp=0, frame="world")
        played, _ = localized(drive, {"scan": drive.scans(), "objects": seen}, {"object_map": [object_map]})
        assert errors(drive, played["pose"])[0] < 0.1
        digests.append(played.digests())
    assert digests[0] == digests[1]


def test_non_finite_or_late_odometry_is_counted_and_localization_continues() -> None:
    drive = Drive(4.0)
    odometry: list[Any] = drive.odometry()
    for k in (30, 31, 50):
        odometry[k] = odometry[k].replace(position=[math.nan, 0, 0])
    gyro: list[Any] = drive.gyro()
    gyro[100] = gyro[100].replace(angular_velocity=[0, 0, math.nan])
    played, operator = localized(drive, {"scan": drive.scans(), "imu": gyro}, {"odometry": odometry})
    assert operator.summary()["ignored, odometry: not finite"] == 3
    assert operator.summary()["ignored, measurements/imu: not finite"] == 1
    far, turned, count = errors(drive, played["pose"])
    assert far < 0.1
    assert turned < 2.0
    assert count > 50
    assert operator.process(odometry[-1], {}, map=drive.grid) is None
    assert operator.summary()["ignored, odometry: stamp not later than the last"] == 1


def test_a_position_whose_heading_has_no_variance_counts_without_heading() -> None:
    drive = Drive(4.0)
    C = np.diag([0.05**2, 0.05**2, 1.0, 100.0, 100.0, 0.0])
    places = [p.replace(covariance=C) for p in drive.positions()]
    empty = places[3].replace(stamp=places[3].stamp, covariance=np.zeros((6, 6)))
    played, operator = localized(drive, {"scan": drive.scans(), "place": [*places[:3], empty, *places[4:]]})
    assert operator.summary()["ignored, measurements/place: covariance not positive"] == 1
    assert errors(drive, played["pose"])[0] < 0.1


def test_maps_that_do_not_fit_are_refused() -> None:
    operator = ParticleFilterLocalizer(map_frame="hall")
    operator.setup()
    odometry = Drive(0.2).odometry()[0]
    with pytest.raises(ValueError, match="the map is in 'world', but the robot is looked for in 'hall'"):
        operator.process(odometry, {}, map=room())
    full = room().replace(cells=np.full((4, 4), 100, np.int8), frame="hall")
    with pytest.raises(ValueError, match="no free cell among its 16"):
        operator.process(odometry, {}, map=full)
    nowhere = room().replace(position=[np.nan, 0, 0], frame="hall")
    with pytest.raises(ValueError, match="the map's place in 'hall' is not finite"):
        operator.process(odometry, {}, map=nowhere)
    place = Pose(stamp=1, frame="hall", child_frame="base_link", position=[0, 0, 0], orientation=[0, 0, 0, 1])
    with pytest.raises(ValueError, match="its messages have no covariance"):
        operator.process(odometry.replace(stamp=10), {"ns/place/pose": place})
    with pytest.raises(ValueError, match="min_particles 900 is above max_particles 800"):
        ParticleFilterLocalizer(min_particles=900, max_particles=800).setup()


def test_a_saved_map_localizes_as_the_stream_does(tmp_path: Path) -> None:
    drive = Drive(3.0)
    write_map(drive.grid, tmp_path / "room.yaml")
    assert np.array_equal(read_map(tmp_path / "room.yaml", "world").cells, drive.grid.cells)
    played, _ = localized(drive, {"scan": drive.scans()}, {"map": []}, map_file=str(tmp_path / "room.yaml"))
    assert errors(drive, played["pose"])[0] < 0.1


def test_a_turned_map_is_looked_up_in_its_own_axes() -> None:
    drive = Drive(3.0)
    a = 0.5
    R = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    turned = drive.grid.replace(
        position=np.array([*(R @ drive.grid.position[:2]), 0.0]), orientation=quaternion_from_yaw(a)
    )
    played, _ = localized(drive, {"scan": drive.scans()}, {"map": [turned]})
    last = played["pose"][-1]
    true = drive.pose(last.stamp * 1e-9)
    assert np.hypot(*(R.T @ last.position[:2] - true[:2])) < 0.1
    assert abs(float(yaw_of(last.orientation)) - true[2] - a) % (2 * math.pi) < 0.04


def test_a_map_file_that_is_none_is_named(tmp_path: Path) -> None:
    file = tmp_path / "map.yaml"
    file.write_text("image: map.pgm\nresolution: 0.05\n")
    with pytest.raises(ValueError, match="must give image, resolution and origin"):
        read_map(file, "world")
    file.write_text("image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(FileNotFoundError, match=r"names the image 'map.pgm'"):
        read_map(file, "world")
