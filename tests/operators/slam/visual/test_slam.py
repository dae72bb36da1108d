"""Visual SLAM in a made room with known truth: loops, saved maps, other rooms, failures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from operator_runs import assert_one_calibration, assert_resumes_alike, errors_in_map, texts

from dataflow.messages import CameraInfo, DepthImage, Image
from dataflow.testing import Played, play
from operators.geometry.se3 import Matrix
from operators.odometry import VisualOdometry
from operators.slam import VisualSlam
from operators.slam.visual.map_file import read_visual_map
from operators.sources.room import Room, camera_path, look_at

SIZE = (192, 144)
K = np.array([[158.0, 0.0, 95.5], [0.0, 158.0, 71.5], [0.0, 0.0, 1.0]])
ROUND = 36  # frames

Frame = tuple[NDArray[np.uint8], NDArray[np.float32]]


def on_round(count: int, first: int = 0) -> list[Matrix]:
    """T_world_camera on a path around the table that closes after `ROUND` frames."""
    return [camera_path(first + k, ROUND) for k in range(count)]


def elsewhere(count: int) -> list[Matrix]:
    """A camera that looks at the table from nearer and higher than on the round, and drifts sideways."""
    eyes = [np.array([1.1 - 0.04 * k, 0.75 + 0.02 * k, 1.45]) for k in range(count)]
    return [look_at(eye, np.array([0.0, 0.0, 0.55])) for eye in eyes]


@cache
def room(seed: int) -> Room:
    return Room(seed)


@cache
def frame(seed: int, pose: bytes) -> Frame:
    T = np.frombuffer(pose).reshape(4, 4)
    view = room(seed).render(T, K, SIZE)
    rng = np.random.default_rng([seed, int(1e6 * abs(T[0, 3]))])
    image = np.clip(view.image + rng.normal(0, 2, view.image.shape), 0, 255).astype(np.uint8)
    depth = view.depth + 0.0015 * view.depth**2 * rng.standard_normal(view.depth.shape)
    return image, depth.astype(np.float32)


def frames(poses: Sequence[Matrix], seed: int = 0) -> list[Frame]:
    return [frame(seed, T.tobytes()) for T in poses]


def info(name: str, error: float = 0.0) -> CameraInfo:
    wrong = K.copy()
    wrong[:2, :2] *= 1.0 + error
    return CameraInfo(stamp=0, frame=name, width=SIZE[0], height=SIZE[1], K=wrong)


def streams(seen: Sequence[Frame], focal_error: float = 0.0) -> dict[str, list]:
    stamps = [100_000_000 * k for k in range(len(seen))]
    return {
        "image": [Image(stamp=t, frame="color", data=image) for t, (image, _) in zip(stamps, seen, strict=True)],
        "depth": [DepthImage(stamp=t, frame="depth", data=depth) for t, (_, depth) in zip(stamps, seen, strict=True)],
        "image_info": [info("color", focal_error)],
        "depth_info": [info("depth", focal_error)],
    }


STATIC = ("image_info", "depth_info")


def run(seen: Sequence[Frame], focal_error: float = 0.0, **params: object) -> Played:
    return play(VisualSlam(**params), streams(seen, focal_error), static=STATIC)


@pytest.fixture(scope="module")
def around() -> Played:
    """A round and a bit more, from a calibrated camera."""
    return run(frames(on_round(ROUND + 6)))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a round."""
    file: Path = tmp_path_factory.mktemp("maps") / "room.npz"
    run(frames(on_round(ROUND)), save=str(file))
    return file


@pytest.mark.long
def test_odometry_is_that_of_visual_odometry_and_pose_is_its_correction(around: Played) -> None:
    plain = play(VisualOdometry(), streams(frames(on_round(ROUND + 6))), static=STATIC)
    assert around.digests()["odometry"] == plain.digests()["odometry"]
    for odometry, correction, pose in zip(around["odometry"], around["correction"], around["pose"], strict=True):
        assert (correction.frames, correction.child_frames) == (("map",), ("odom",))
        np.testing.assert_allclose(correction.matrices()[0] @ odometry.matrix(), pose.matrix(), atol=1e-9)
        assert (pose.frame, pose.child_frame, pose.stamp) == ("map", "depth", odometry.stamp)


@pytest.mark.long
def test_a_loop_takes_drift_away() -> None:
    """A focal length that is 1.5 % wrong makes the odometry drift on its way around."""
    poses = on_round(ROUND + 10)
    played = run(frames(poses), focal_error=0.015)
    assert any(text.startswith("corrected") for text in texts(played))
    corrected = errors_in_map(played["pose"], poses, poses[0])
    drifted = errors_in_map(played["odometry"], poses, poses[0])
    # Back at the start the map is known exactly: it was begun there.
    assert drifted[ROUND] > 0.03
    assert corrected[ROUND + 5] < 0.5 * drifted[ROUND + 5]
    assert len(played["path"]) > 0
    stamps = {pose.stamp for pose in played["pose"]}
    for path in played["path"]:
        assert set(path.stamps.tolist()) <= stamps
        assert path.stamps[-1] <= path.stamp
    assert len(played["map"]) > 0


@pytest.mark.long
def test_the_map_does_not_grow_where_it_was_already() -> None:
    played = run(frames(on_round(ROUND + 18)))
    views = [int(s.values[s.keys.index("views")]) for s in played["status"]]
    assert views[-1] - views[ROUND] < 0.5 * (views[18] - views[0])


@pytest.mark.long
def test_a_saved_map_is_found_from_elsewhere(saved: Path) -> None:
    poses = elsewhere(10)
    played = run(frames(poses), map_file=str(saved))
    assert "corrected: the map is found" in texts(played)
    assert len(played["pose"]) >= 5
    found = errors_in_map(played["pose"], poses[-len(played["pose"]) :], on_round(1)[0])
    assert found.max() < 0.05


@pytest.mark.long
def test_a_saved_map_of_another_room_is_not_found(saved: Path) -> None:
    played = run(frames(elsewhere(10), seed=5), map_file=str(saved))
    assert {text.split(":")[0] for text in texts(played)} == {"searching"}
    assert played["pose"] == []
    assert played["correction"] == []


def test_a_saved_map_has_the_same_bytes_each_time(tmp_path: Path) -> None:
    seen = frames(on_round(10))
    for name in ("a.npz", "b.npz"):
        run(seen, save=str(tmp_path / name))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert len(read_visual_map(tmp_path / "a.npz")) > 2


def tiled_floor(poses: Sequence[Matrix], period: float = 1.2) -> list[Frame]:
    """A floor, z = 0, whose pattern of a few hundred patches comes again at every `period` metres."""
    pattern = np.random.default_rng(4).integers(30, 226, (40, 40), np.uint8)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    seen = []
    for k, T in enumerate(poses):
        depth = -T[2, 3] / (rays @ T[2, :3])
        at = (T[:3, 3] + (rays * depth[..., None]) @ T[:3, :3].T)[..., :2] / period % 1.0
        cells = (40 * at).astype(np.int64)
        noise = np.random.default_rng(k).standard_normal(depth.shape)
        grey = pattern[cells[..., 0], cells[..., 1]]
        seen.append((np.repeat(grey[..., None], 3, axis=2), (depth + 0.0015 * depth**2 * noise).astype(np.float32)))
    return seen


def over_floor(first: float, count: int) -> list[Matrix]:
    """A camera that looks down aslant and moves along x."""
    return [
        look_at(np.array([first + 0.05 * k, 0.0, 1.2]), np.array([first + 0.05 * k + 0.5, 0.1, 0.0]))
        for k in range(count)
    ]


def test_a_floor_that_repeats_is_no_place_to_be_found_at(tmp_path: Path) -> None:
    file = tmp_path / "floor.npz"
    mapped = run(tiled_floor(over_floor(0.0, 14)), save=str(file))
    assert texts(mapped)[-1].startswith("mapped")
    assert len(read_visual_map(file)) > 2
    tried = run(tiled_floor(over_floor(1.22, 10)), map_file=str(file))  # 1.2 m off it sees the same
    assert {text.split(":")[0] for text in texts(tried)} == {"searching"}


@pytest.mark.long
def test_blind_frames_are_reported_and_bridged() -> None:
    poses = on_round(24)
    seen = frames(poses)
    dark = [(np.zeros_like(i), np.full_like(d, np.nan)) if 12 <= k < 15 else (i, d) for k, (i, d) in enumerate(seen)]
    played = run(dark)
    told = texts(played)
    assert all(text.startswith("adrift: odometry") for text in told[12:15])
    assert told[-1].startswith(("mapped", "corrected"))
    assert errors_in_map(played["pose"], poses, poses[0])[-1] < 0.05


@pytest.mark.long
def test_repeated_calibration_is_the_same_and_another_is_refused() -> None:
    assert_one_calibration(
        VisualSlam, streams(frames(on_round(8))), STATIC[::-1], "image", info("color", 0.1), 5
    )  # fmt: skip


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    given = streams(frames(on_round(ROUND + 4)))
    calibration = given["image_info"][0], given["depth_info"][0]
    firings = [(*pair, *calibration) for pair in zip(given["image"], given["depth"], strict=True)]
    assert_resumes_alike(VisualSlam, firings, ROUND - 4)


@pytest.mark.long
def test_covariance_covers_the_error(around: Played) -> None:
    poses = on_round(ROUND + 6)
    squares = []
    for pose, T in zip(around["pose"][1:], poses[1:], strict=True):
        off = (poses[0] @ pose.matrix())[:3, 3] - T[:3, 3]
        R = poses[0][:3, :3]
        squares.append(off @ np.linalg.solve(R @ pose.pose_covariance[:3, :3] @ R.T, off) / 3)
    assert 0.005 < np.mean(squares) < 3.0
