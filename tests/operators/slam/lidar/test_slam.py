"""LiDAR SLAM in a made room with known truth: loops, saved maps, other rooms, failures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from operator_runs import assert_resumes_alike, errors_in_map, texts

from dataflow.messages import PointCloud, Transforms
from dataflow.messages.geometry import invert
from dataflow.testing import Played, play
from operators.cloud.registration import Settings
from operators.geometry.se3 import Matrix
from operators.odometry import LidarOdometry
from operators.odometry.lidar.tracker import Tracked
from operators.odometry.tracking import Status
from operators.slam import LidarSlam
from operators.slam.lidar.graph import LidarGraph, LidarSettings
from operators.slam.lidar.map_file import read_lidar_map
from operators.slam.lidar.mapper import LidarMapper
from operators.slam.lidar.view import LidarEyes, LidarView
from operators.slam.place import MappingResult, Place
from tests.support.made_scans import HALL, HALL_BOXES, NOTHING, at, drifting, on_round, scan

ROUND = 28  # scans
STEP = 250_000_000  # ns
NEAR = {"keyframe": 0.35, "travel": 2.5}


@cache
def seen(pose: bytes, seed: int, room: str = "room") -> NDArray[np.float32]:
    T = np.frombuffer(pose).reshape(4, 4)
    if room == "hall":
        return scan(T, seed, HALL, HALL_BOXES)
    if room == "square":
        return scan(T, seed, np.array([3.0, 3.0, 1.2]), NOTHING)
    return scan(T, seed)


def clouds(poses: Sequence[Matrix], room: str = "room", first: int = 0) -> list[PointCloud]:
    return [
        PointCloud(stamp=(first + k + 1) * STEP, frame="lidar", points=seen(T.tobytes(), first + k, room))
        for k, T in enumerate(poses)
    ]


def run(given: list[PointCloud], **params: object) -> Played:
    return play(LidarSlam(**(NEAR | params)), {"cloud": given})


def elsewhere(count: int) -> list[Matrix]:
    """A LiDAR that crosses the room beside the round, turned round."""
    return [at(-1.0 + 0.12 * k, -1.1 + 0.03 * k, 2.6 + 0.05 * k) for k in range(count)]


@pytest.fixture(scope="module")
def around() -> Played:
    """A round and a bit more."""
    return run(clouds(on_round(ROUND + 5)))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a round."""
    file: Path = tmp_path_factory.mktemp("maps") / "room.npz"
    run(clouds(on_round(ROUND)), save=str(file))
    return file


# -- odometry and correction ---------------------------------------------------------------------------------


@pytest.mark.long
def test_odometry_is_that_of_lidar_odometry_and_pose_is_its_correction(around: Played) -> None:
    plain = play(LidarOdometry(), {"cloud": clouds(on_round(ROUND + 5))})
    assert around.digests()["odometry"] == plain.digests()["odometry"]
    for odometry, correction, pose in zip(around["odometry"], around["correction"], around["pose"], strict=True):
        assert (correction.frames, correction.child_frames) == (("map",), ("odom",))
        np.testing.assert_allclose(correction.matrices()[0] @ odometry.matrix(), pose.matrix(), atol=1e-9)
        assert (pose.frame, pose.child_frame, pose.stamp) == ("map", "lidar", odometry.stamp)


def test_a_place_seen_again_is_a_loop_and_the_map_does_not_grow_there(around: Played) -> None:
    told = texts(around)
    assert any(text.startswith("corrected") for text in told[ROUND - 2 :])
    assert not any(text.startswith("corrected") for text in told[: ROUND // 2])
    views = [int(s.values[s.keys.index("views")]) for s in around["status"]]
    assert views[-1] - views[ROUND - 1] <= 1
    assert errors_in_map(around["pose"], on_round(ROUND + 5), on_round(1)[0]).max() < 0.03
    assert len(around["path"]) > 0
    assert len(around["map"]) > 0


@pytest.mark.long
def test_poses_are_those_of_the_body_where_one_is_named() -> None:
    mount = at(0.3, 0.1, 0.4)
    extrinsics = Transforms.from_matrix(mount, stamp=0, frame="base_link", child_frame="lidar")
    given = {"cloud": clouds(on_round(ROUND + 4)), "extrinsics": [extrinsics]}
    played = play(LidarSlam(body_frame="base_link", **NEAR), given, static=("extrinsics",))
    bodies = [T @ invert(mount) for T in on_round(ROUND + 4)]
    assert played["pose"][-1].child_frame == "base_link"
    assert errors_in_map(played["pose"], bodies, bodies[0]).max() < 0.03
    walls = played["map"][-1].points @ bodies[0][:3, :3].T + bodies[0][:3, 3]
    assert np.quantile(np.abs(walls[:, 0]), 0.99) == pytest.approx(4.0, abs=0.1)  # half the room's length


def test_covariance_covers_the_error(around: Played) -> None:
    truth = on_round(ROUND + 5)
    R, squares = truth[0][:3, :3], []
    for pose, T in zip(around["pose"][1:], truth[1:], strict=True):
        off = (truth[0] @ pose.matrix())[:3, 3] - T[:3, 3]
        squares.append(off @ np.linalg.solve(R @ pose.pose_covariance[:3, :3] @ R.T, off) / 3)
    assert 0.005 < np.mean(squares) < 3.0


# -- loops of an odometry that drifts ------------------------------------------------------------------------


def mapper(rivals: int = 3) -> LidarMapper:
    eyes = LidarEyes(Settings(0.1, 1, 0.5, 0.9, 0.04), Settings(0.1, 1, 0.5, 0.9, 0.08), 0.03, 10.0, 0.5)
    graph = LidarGraph(LidarSettings(spacing=0.35, travel=2.5, searched=rivals), eyes)
    return LidarMapper(graph, lambda points: LidarView(points, 10.0, 0.1))


def tracked(
    T: Matrix, points: NDArray[np.float32] | None, covariance: Matrix, state: Status = Status.TRACKING
) -> Tracked:
    none = np.zeros((0, 6))
    given = None if points is None else points.astype(np.float64)
    return Tracked(state, "", T, covariance, np.zeros(6), None, none, {}, given)


def mapped(poses: Sequence[Matrix], said: Sequence[Matrix], slam: LidarMapper) -> list[MappingResult]:
    """What becomes of scans from `poses` whose odometry says `said`."""
    grown = np.diag([1e-2**2] * 6)
    return [
        slam.take(tracked(T, seen(at.tobytes(), k), (k + 1) * grown), (k + 1) * STEP)
        for k, (at, T) in enumerate(zip(poses, said, strict=True))
    ]


@pytest.mark.long
def test_a_loop_takes_drift_away() -> None:
    poses = on_round(ROUND + 5)
    said = drifting(poses)
    slam = mapper()
    found = mapped(poses, said, slam)
    truth = invert(poses[0]) @ poses[-1]
    last = found[-1].T_map_odom
    assert last is not None
    assert np.linalg.norm((said[-1] - truth)[:3, 3]) > 0.2
    assert np.linalg.norm((last @ said[-1] - truth)[:3, 3]) < 0.03
    (middle,) = (n for n in slam.graph.nodes.values() if n.stamp == (ROUND // 2 + 1) * STEP)
    true = invert(poses[0]) @ poses[ROUND // 2]  # the pose graph puts the middle of the round right too
    assert np.linalg.norm((middle.T - true)[:3, 3]) < 0.6 * np.linalg.norm((said[ROUND // 2] - true)[:3, 3])


@pytest.mark.long
def test_new_odometry_map_is_joined_after_two_agreeing_scans() -> None:
    """The LiDAR is lost and carried across the room; its odometry begins anew, with a pose that means nothing."""
    slam, poses = mapper(), on_round(ROUND)
    mapped(poses, [invert(poses[0]) @ T for T in poses], slam)
    lost = slam.take(tracked(np.eye(4), None, np.eye(6), Status.LOST), 40 * STEP)
    assert (lost.place, lost.T_map_odom) == (Place.ADRIFT, None)
    there, wrong = elsewhere(16), at(9.0, -4.0, 1.0)
    results = [
        slam.take(tracked(wrong @ invert(there[0]) @ T, seen(T.tobytes(), 50 + k), np.eye(6)), (41 + k) * STEP)
        for k, T in enumerate(there)
    ]
    assert results[0].place is Place.SEARCHING
    assert results[0].T_map_odom is None
    (found,) = [k for k, result in enumerate(results) if result.added.found]
    assert found > 0
    T = results[-1].T_map_odom
    assert T is not None
    pose = poses[0] @ T @ wrong @ invert(there[0]) @ there[-1]
    assert np.linalg.norm((pose - there[-1])[:3, 3]) < 0.03


# -- saved maps ----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_saved_map_is_found_from_elsewhere(saved: Path) -> None:
    poses = elsewhere(16)
    played = run(clouds(poses, first=60), map_file=str(saved))
    assert "corrected: the map is found" in texts(played)
    assert len(played["pose"]) >= 5
    assert errors_in_map(played["pose"], poses[-len(played["pose"]) :], on_round(1)[0]).max() < 0.04


@pytest.mark.long
def test_a_saved_map_of_another_room_is_not_found(saved: Path) -> None:
    played = run(clouds(elsewhere(8), "hall"), map_file=str(saved))
    assert {text.split(":")[0] for text in texts(played)} == {"searching"}
    assert played["pose"] == []
    assert played["correction"] == []


@pytest.mark.long
def test_a_room_that_looks_alike_in_four_headings_is_not_found(tmp_path: Path) -> None:
    run(clouds(on_round(ROUND), "square"), save=str(tmp_path / "square.npz"))
    played = run(clouds(elsewhere(8), "square", first=60), map_file=str(tmp_path / "square.npz"))
    assert played["pose"] == []
    assert any("ambiguous" in text for text in texts(played))


def test_a_saved_map_has_the_same_bytes_each_time(tmp_path: Path) -> None:
    given = clouds(on_round(8))
    for name in ("a.npz", "b.npz"):
        run(given, save=str(tmp_path / name))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert len(read_lidar_map(tmp_path / "a.npz")) > 2


# -- bad scans, repeats --------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((500, 3), np.nan)])
def test_scans_that_tell_nothing_are_named_and_survived(points: NDArray[np.float64]) -> None:
    poses = on_round(14)
    given = clouds(poses)
    given[7] = given[7].replace(points=points.astype(np.float32))
    played = run(given)
    assert texts(played)[7].startswith("adrift: odometry predicted: 0 usable points")
    assert texts(played)[-1].startswith("mapped")
    assert errors_in_map(played["pose"], poses, poses[0])[-1] < 0.03


def test_nothing_but_empty_scans_gives_no_pose() -> None:
    nothing = np.zeros((0, 3), np.float32)
    played = run([PointCloud(stamp=(k + 1) * STEP, frame="lidar", points=nothing) for k in range(4)])
    assert {text.split(":")[0] for text in texts(played)} == {"adrift"}
    assert played["pose"] == played["odometry"] == played["map"] == []


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    assert_resumes_alike(lambda: LidarSlam(**NEAR), [(cloud,) for cloud in clouds(on_round(ROUND + 4))], ROUND - 3)


@pytest.mark.long
def test_operator_restored_while_a_saved_map_is_searched_resumes_alike(saved: Path) -> None:
    firings = [(cloud,) for cloud in clouds(elsewhere(12), first=60)]

    def make() -> LidarSlam:
        return LidarSlam(map_file=str(saved), **NEAR)

    probe, searching = make(), 0
    probe.setup()
    while not (probe.state.mapper.graph.search and probe.state.mapper.graph.search.sights):
        probe.process(*firings[searching])
        searching += 1
    assert_resumes_alike(make, firings, searching)
