"""RGB-D odometry against rendered rooms with known motion, against failures, and against recorded data."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from operator_runs import assert_one_calibration, assert_resumes_alike, largest_errors

from dataflow.messages import CameraInfo, DepthImage, Image
from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.odometry import VisualOdometry
from operators.odometry.rgbd import tracker
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fit, Fitter
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import Surface, scaled_intrinsics
from operators.odometry.rgbd.tracker import RgbdOdometry, RgbdState
from operators.odometry.rgbd.trial import Trial, with_trial
from operators.odometry.tracking import MEASURED, Status, TrackResult, moved_covariance

SIZE = (320, 240)
K_COLOR = np.array([[262.0, 0.0, 159.5], [0.0, 262.0, 119.5], [0.0, 0.0, 1.0]])
K_DEPTH = np.array([[292.0, 0.0, 159.5], [0.0, 292.0, 119.5], [0.0, 0.0, 1.0]])
ROOM = np.array([[-2.0, -1.2, -1.5], [2.0, 1.2, 2.5]])  # opposite corners, metres
TENTH = 100_000_000  # ns
CRATE = np.array([[0.3, 0.4, 1.4], [0.9, 1.2, 2.0]])

Frame = tuple[NDArray[np.uint8], NDArray[np.float32]]


# -- a room to look at ---------------------------------------------------------------------------------------


def box_texture() -> NDArray[np.uint8]:
    """Smooth random spots: corners at every scale."""
    rng = np.random.default_rng(4)
    layers = [
        cv2.resize(rng.random((n, n), np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC) for n in (16, 64, 160)
    ]
    mixed = sum(layers) / 3.0
    return np.clip((mixed - 0.5) * 400 + 128, 0, 255).astype(np.uint8)


TEXTURE = box_texture()


def render(T_world_camera: NDArray[np.float64], K: NDArray[np.float64]) -> Frame:
    """Grey image and depth (z) of the room and the crate in it, by casting a ray through every pixel."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    R, o = T_world_camera[:3, :3], T_world_camera[:3, 3]
    d = [(R[k, 0] * x + R[k, 1] * y + R[k, 2] + 1e-9).astype(np.float32) for k in range(3)]  # z = 1 in the camera
    walls = [np.maximum((ROOM[0][k] - o[k]) / d[k], (ROOM[1][k] - o[k]) / d[k]) for k in range(3)]
    near = [np.minimum((CRATE[0][k] - o[k]) / d[k], (CRATE[1][k] - o[k]) / d[k]) for k in range(3)]
    far = [np.maximum((CRATE[0][k] - o[k]) / d[k], (CRATE[1][k] - o[k]) / d[k]) for k in range(3)]
    entry, wall = np.maximum.reduce(near), np.minimum.reduce(walls)
    on_crate = (entry < np.minimum.reduce(far)) & (entry > 0)
    z = np.where(on_crate, entry, wall)
    # The axis that each pixel's face is normal to, and a number of its own for each face.
    faces, sides = [], []
    for k in range(3):
        faces.append(np.where(on_crate, near[k] == entry, walls[k] == wall))
        sides.append(np.where(on_crate, 7 + k, k + 3 * (d[k] > 0)))
    px, py, pz = (o[k] + d[k] * z for k in range(3))
    side = np.select(faces, sides)
    map_x = ((np.where(faces[0], py, px) * 200 + 137 * side) % 1023).astype(np.float32)
    map_y = ((np.where(faces[2] & ~faces[0], py, pz) * 200 + 331 * side) % 1023).astype(np.float32)
    return cv2.remap(TEXTURE, map_x, map_y, cv2.INTER_LINEAR), z.astype(np.float32)


def view(T_world_camera: NDArray[np.float64]) -> Frame:
    """What colour and depth camera, at one place, see."""
    return render(T_world_camera, K_COLOR)[0], render(T_world_camera, K_DEPTH)[1]


def handheld(count: int, speed: float = 1.0) -> list[NDArray[np.float64]]:
    """T_world_camera of a camera that sways and turns; the first is the identity."""
    s = speed * np.arange(count) / 30.0
    way = 0.3 * np.sin(s), 0.1 * np.sin(1.7 * s), 0.2 * (1 - np.cos(s))
    return [se3.exp(x) for x in np.column_stack([*way, 0.1 * np.sin(1.3 * s), 0.4 * s, 0.1 * s])]


Sequence = tuple[list[Frame], list[NDArray[np.float64]]]


def sequence(count: int, speed: float = 1.0, offset: float = 0.0) -> Sequence:
    """Frames with noisy, quantised depth; the colour camera sits `offset` metres to the right."""
    return rendered(count, speed, offset)


@cache
def rendered(count: int, speed: float, offset: float) -> Sequence:
    poses = handheld(count, speed)
    T_depth_color = camera(offset).T_depth_color
    rng = np.random.default_rng(7)
    frames = []
    for T in poses:
        gray, _ = render(T @ T_depth_color, K_COLOR)
        _, depth = render(T, K_DEPTH)
        depth = depth + 0.0015 * depth**2 * rng.standard_normal(depth.shape)
        frames.append((gray, (np.round(depth * 1000) / 1000).astype(np.float32)))
    return frames, poses


def camera(offset: float = 0.0) -> RgbdCamera:
    T_depth_color = np.eye(4)
    T_depth_color[0, 3] = offset
    return RgbdCamera(K_COLOR, K_DEPTH, T_depth_color)


def follow(
    frames: Iterable[Frame], config: RgbdOdometryConfig | None = None, offset: float = 0.0, rate: float = 30.0
) -> list[TrackResult]:
    odometry = RgbdOdometry(camera(offset), config)
    return [odometry.track(image, depth, int(i * 1e9 / rate)) for i, (image, depth) in enumerate(frames)]


@cache
def followed(count: int, speed: float, offset: float, refine: bool, rate: float) -> list[TrackResult]:
    """What follows from `sequence(count, speed, offset)` as it is."""
    return follow(sequence(count, speed, offset)[0], RgbdOdometryConfig(refine=refine), offset, rate)


def digest(results: list[TrackResult]) -> str:
    h = hashlib.sha256()
    for r in results:
        h.update(r.T_world_camera.tobytes() + r.covariance.tobytes() + r.velocity.tobytes())
        h.update(f"{r.status} {r.inliers} {r.keyframe}".encode())
    return h.hexdigest()


def black(frame: Frame) -> Frame:
    return np.zeros_like(frame[0]), frame[1]


def without_depth(frame: Frame) -> Frame:
    return frame[0], np.full_like(frame[1], np.nan)


# -- accuracy ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "speed", "rate", "offset", "refine", "metres", "radians"),
    [
        pytest.param(40, 1.0, 30.0, 0.0, True, 0.012, 0.006, marks=pytest.mark.long),  # slow
        pytest.param(40, 1.0, 30.0, 0.0, False, 0.03, 0.015, marks=pytest.mark.long),  # slow, features only
        pytest.param(25, 3.0, 10.0, 0.0, True, 0.015, 0.008, marks=pytest.mark.long),  # 10 Hz: 2.3 degrees a frame
        (25, 3.0, 10.0, 0.05, True, 0.015, 0.008),  # two cameras 5 cm apart
        (25, 3.0, 10.0, 0.05, False, 0.04, 0.02),  # the same, features only
    ],
)
def test_pose_follows_known_motion(
    count: int, speed: float, rate: float, offset: float, refine: bool, metres: float, radians: float
) -> None:
    _, poses = sequence(count, speed, offset)
    results = followed(count, speed, offset, refine, rate)
    assert all(r.status is Status.TRACKING for r in results[1:])
    position, rotation = largest_errors(results, poses)
    assert position < metres
    assert rotation < radians


def test_unmodelled_extrinsics_cost_accuracy() -> None:
    """The extrinsics are used: features alone do worse when the 5 cm between the cameras are left out."""
    frames, poses = sequence(25, 3.0, 0.05)
    told = largest_errors(followed(25, 3.0, 0.05, False, 10.0), poses)[0]
    untold = largest_errors(follow(frames, RgbdOdometryConfig(refine=False), 0.0, 10.0), poses)[0]
    assert told < 0.7 * untold


@pytest.mark.long
def test_pure_rotation_is_followed() -> None:
    poses = [se3.exp(np.array([0, 0, 0, 0, 0.03 * i, 0])) for i in range(15)]
    frames = [view(T) for T in poses]
    position, rotation = largest_errors(follow(frames), poses)
    assert position < 0.01
    assert rotation < 0.005


@pytest.mark.long
def test_exposure_changes_are_followed() -> None:
    frames, poses = sequence(40)
    flicker = [
        (cv2.convertScaleAbs(gray, alpha=0.6 + 0.4 * (i % 5 != 0)), depth) for i, (gray, depth) in enumerate(frames)
    ]
    results = follow(flicker)
    assert all(r.status is Status.TRACKING for r in results[1:])
    assert largest_errors(results, poses)[0] < 0.015


def test_covariance_covers_the_error_and_grows_with_the_way() -> None:
    _, poses = sequence(40)
    results = followed(40, 1.0, 0.0, True, 30.0)
    x = np.array([se3.log(invert(T) @ r.T_world_camera) for r, T in zip(results, poses, strict=True)])[1:]
    squared = [e @ np.linalg.solve(r.covariance, e) / 6 for e, r in zip(x, results[1:], strict=True)]
    assert 0.01 < np.mean(squared) < 3.0
    for r in results[1:]:
        np.testing.assert_allclose(r.covariance, r.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(r.covariance)[0] > 0


@pytest.mark.long
def test_a_pose_is_less_certain_than_the_keyframe_that_it_is_measured_against() -> None:
    odometry = RgbdOdometry(camera())
    for i, frame in enumerate(sequence(25, 3.0)[0]):
        result, keyframes = odometry.track(*frame, i * 100_000_000), odometry.state.map.keyframes
        if i > 0 and not result.keyframe:
            newest = keyframes[-1]
            carried = moved_covariance(newest.covariance, newest.T_world_camera, result.T_world_camera)
            assert np.linalg.eigvalsh(result.covariance - carried)[0] > 0


@pytest.mark.long
def test_first_frames_of_a_camera_that_tracks_well_count_as_those_after_them() -> None:
    """Nothing is known of the noise then; the doubt would stay in every later pose."""
    odometry, added = RgbdOdometry(camera()), []
    for i, frame in enumerate(sequence(40, 1.0)[0]):
        known = odometry.state.map.keyframes[-1] if i else None
        result = odometry.track(*frame, i * 100_000_000)
        if known is not None:
            carried = moved_covariance(known.covariance, known.T_world_camera, result.T_world_camera)
            added.append(np.sqrt(np.trace((result.covariance - carried)[:3, :3])))
    assert max(added[:5]) < 5 * np.median(added[20:])


# -- failures ------------------------------------------------------------------------------------------------


def test_black_images_fall_back_to_depth() -> None:
    frames, poses = sequence(40)
    frames = [black(f) if 10 <= i < 20 else f for i, f in enumerate(frames)]
    results = follow(frames)
    assert {r.status for r in results[10:20]} == {Status.TRACKING}
    assert {r.reason for r in results[10:20]} == {"depth; image is black"}
    assert all(r.status is Status.TRACKING for r in results[22:])
    assert largest_errors(results, poses)[0] < 0.03


def test_lost_depth_falls_back_to_features() -> None:
    frames, poses = sequence(40)
    frames = [without_depth(f) if 10 <= i < 20 else f for i, f in enumerate(frames)]
    results = follow(frames)
    assert all(r.status is Status.TRACKING for r in results[1:])
    assert largest_errors(results, poses)[0] < 0.03


@pytest.mark.long
def test_blindness_is_bridged_and_recovered_from() -> None:
    frames, poses = sequence(40)
    frames = [black(without_depth(f)) if 10 <= i < 20 else f for i, f in enumerate(frames)]
    results = follow(frames)
    assert {r.status for r in results[10:20]} == {Status.PREDICTED}
    assert results[10].reason == "image is black; depth has no return"
    sigmas = [np.sqrt(np.trace(r.covariance[:3, :3])) for r in results[9:20]]
    assert all(b > a for a, b in pairwise(sigmas))
    assert sigmas[-1] > 3 * sigmas[0]
    assert results[20].status in MEASURED
    assert largest_errors(results[20:], poses[20:])[0] < 0.03


@pytest.mark.long
def test_lost_depth_is_bridged_by_the_depth_of_the_map() -> None:
    """Twenty degrees of turning without depth: new corners take theirs from what the map expects there."""
    frames, poses = sequence(60, 1.5)
    results = follow([without_depth(f) if 10 <= i < 50 else f for i, f in enumerate(frames)])
    assert {r.status for r in results} == {Status.TRACKING}
    assert any(r.keyframe for r in results[12:50])
    assert largest_errors(results, poses)[0] < 0.04


@pytest.mark.parametrize("share", [pytest.param(0.5, marks=pytest.mark.long), 0.9])
def test_sparse_depth_is_depth(share: float) -> None:
    frames, poses = sequence(25, 3.0)
    rng = np.random.default_rng(3)
    holes = [(g, np.where(rng.random(d.shape) < share, np.float32(0), d)) for g, d in frames]
    results = follow(holes, rate=10.0)
    assert {r.status for r in results} == {Status.TRACKING}
    assert largest_errors(results, poses)[0] < 0.03


def test_holes_in_the_depth_make_no_more_keyframes() -> None:
    """Half of the depth is missing, in blocks, elsewhere in each frame."""
    rng = np.random.default_rng(3)
    frames, poses = sequence(25)
    kept = [np.kron(rng.random((SIZE[1] // 16, SIZE[0] // 16)) < 0.5, np.ones((16, 16))) > 0 for _ in frames]
    results = follow([(g, np.where(k, d, np.float32(0))) for (g, d), k in zip(frames, kept, strict=True)])
    assert {r.status for r in results} == {Status.TRACKING}
    assert sum(r.keyframe for r in results) <= 10  # 5 with the whole depth
    assert largest_errors(results, poses)[0] < 0.01


@pytest.mark.long
def test_keyframes_are_renewed_where_depth_reaches_less_far() -> None:
    """Most of what comes into view is beyond the reach of the depth camera: poorer keyframes are all that there is."""
    frames, poses = sequence(60, 1.5)
    far = [(g, np.where(np.arange(SIZE[0]) > 0.4 * SIZE[0], np.float32(0), d)) for g, d in frames]
    results = follow([*frames[:3], *far[3:]])
    assert {r.status for r in results} == {Status.TRACKING}
    assert largest_errors(results, poses)[0] < 0.01


def after_a_second(
    monkeypatch: pytest.MonkeyPatch, off: tuple[float, float, float], scale: int = 1
) -> tuple[TrackResult, NDArray[np.float64]]:
    """What comes of frame 22 a second after frame 20, where what is tracked across the gap errs by metres, and the
    truth; images are `scale` times as large."""
    frames, poses = sequence(60, 1.5)
    larger = camera()
    if scale > 1:
        K = scaled_intrinsics(K_COLOR, scale)
        larger = replace(larger, K_color=K)
        frames = [(cv2.resize(g, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR), d) for g, d in frames]
    odometry = RgbdOdometry(larger)
    for i in range(20):
        odometry.track(*frames[i], int(i * 1e9 / 30))
    refine = odometry._refine

    def erring(*given: Any) -> Fit:
        return replace(refine(*given), T_world_camera=poses[22] @ se3.exp(np.array([*off, 0.0, 0.0, 0.0])))

    monkeypatch.setattr(odometry, "_refine", erring)
    return odometry.track(*frames[22], int(20e9 / 30) + 1_000_000_000), poses[22]


def test_track_across_a_gap_yields_to_a_better_supported_place(monkeypatch: pytest.MonkeyPatch) -> None:
    result, truth = after_a_second(monkeypatch, (0.03, 0.0, 0.0))
    assert result.status in MEASURED
    assert np.linalg.norm((invert(truth) @ result.T_world_camera)[:3, 3]) < 0.02


def test_a_track_across_a_gap_is_believed_whatever_the_size_of_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("operators.odometry.rgbd.tracker.recognised", lambda *_: iter(()))
    result, truth = after_a_second(monkeypatch, (0.0, 0.0, 0.0), scale=2)
    assert result.status in MEASURED
    assert np.linalg.norm((invert(truth) @ result.T_world_camera)[:3, 3]) < 0.02


@pytest.mark.long
def test_a_stream_slower_than_the_patience_is_searched_for_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames each 0.6 s: the first come after a gap for all that is known; one that is missing is a gap."""
    frames, poses = sequence(60, 1.5)
    looked, real = list[int](), tracker.recognised
    odometry = RgbdOdometry(camera())

    def counted(frame: Any, *given: Any) -> Any:
        looked.append(frame.stamp // 600_000_000)
        return real(frame, *given)

    monkeypatch.setattr(tracker, "recognised", counted)
    results = [odometry.track(*frames[i], 600_000_000 * i) for i in range(20) if i != 14]
    assert {r.status for r in results} <= {Status.TRACKING, Status.RELOCALISED}
    assert largest_errors(results, [poses[i] for i in range(20) if i != 14])[0] < 0.03
    assert 15 in looked
    assert len([i for i in looked if 3 <= i < 14]) <= 4


def test_a_view_that_is_found_again_is_remembered_for_the_corners_of_the_next() -> None:
    frames, _ = sequence(60, 1.5)
    odometry = RgbdOdometry(camera())
    for i in range(20):
        odometry.track(*frames[i], int(i * 1e9 / 30))
    result = odometry.track(*frames[12], int(20e9 / 30) + 2_000_000_000)
    assert result.status is Status.RELOCALISED
    assert result.keyframe


def at_a_wrong_place(state: RgbdState, since: int, T_wrong: NDArray[np.float64]) -> RgbdState:
    """The state of an odometry that was found again at stamp `since`, and placed wrong by a motion in the world."""
    T = state.motion.T_world_camera
    known = LocalMap(state.map.capacity)
    known.keyframes = [
        replace(k, T_world_camera=T_wrong @ k.T_world_camera) if k.stamp >= since else k for k in state.map.keyframes
    ]
    wrong = replace(state.motion, T_world_camera=T_wrong @ T)
    trial = Trial.of(since, state.motion.stamp, T, 1e-2 * np.eye(6), T_wrong @ T)
    return replace(state, motion=wrong, map=known, trials=with_trial(state.trials, trial))


def test_wrong_relocalization_is_withdrawn_on_contradiction() -> None:
    frames, poses = sequence(25, 3.0)
    odometry = RgbdOdometry(camera())
    for i in range(9):
        odometry.track(*frames[i], i * TENTH)
    since = odometry.state.map.keyframes[-1].stamp
    odometry.state = at_a_wrong_place(odometry.state, since, se3.exp(np.array([0.5, 0.3, -0.6, 0, 0, 0])))
    results = [odometry.track(*frames[i], i * TENTH) for i in range(9, 19)]
    assert np.linalg.norm((results[0].T_world_camera - poses[9])[:3, 3]) > 0.7
    assert [r.taken_back for r in results[:6]] == [None] * 4 + [since, None]  # after the fifth view
    taken_back = results[4]
    assert (taken_back.status, taken_back.keyframe) == (Status.LOST, True)
    assert np.linalg.norm((taken_back.T_world_camera - poses[13])[:3, 3]) < 0.03
    assert np.sqrt(taken_back.covariance[0, 0]) >= 0.1  # as it was believed before
    assert results[5].status is Status.RELOCALISED
    assert [trial.since for trial in odometry.state.trials] == [taken_back.stamp]
    assert largest_errors(results[5:], poses[14:19])[0] < 0.03


@pytest.mark.long
def test_a_wrong_place_is_taken_back_with_another_that_was_found_meanwhile() -> None:
    frames, poses = sequence(60, 1.5)
    stamps = [int(i * 1e9 / 30) for i in range(len(frames))]
    odometry = RgbdOdometry(camera())
    for i in range(17):
        odometry.track(*frames[i], stamps[i])
    first, second = (k.stamp for k in odometry.state.map.keyframes[-2:])
    state = at_a_wrong_place(odometry.state, first, se3.exp(np.array([0.5, 0.3, -0.6, 0, 0, 0])))
    odometry.state = at_a_wrong_place(state, second, se3.exp(np.array([0.4, -0.4, 0.3, 0, 0, 0.3])))
    results = [odometry.track(*frames[i], stamps[i]) for i in range(17, 60)]
    taken_back = next(k for k, result in enumerate(results) if result.taken_back is not None)
    assert results[taken_back].taken_back == first
    assert np.linalg.norm((results[taken_back].T_world_camera - poses[17 + taken_back])[:3, 3]) < 0.05
    assert largest_errors(results[-5:], poses[-5:])[0] < 0.03


def test_a_find_that_moves_nothing_leaves_the_place_that_is_on_trial() -> None:
    there = se3.exp(np.array([0.5, 0.3, -0.6, 0, 0, 1.0]))
    running = with_trial((), Trial.of(0, 0, np.eye(4), np.eye(6), there))
    near, far = se3.exp(np.array([0.1, 0, 0, 0, 0, 0])), se3.exp(np.array([0, 0, 0, 0, 3.0, 0]))
    assert with_trial(running, Trial.of(1, 1, there, np.eye(6), there @ near)) == running
    assert len(with_trial(running, Trial.of(1, 1, there, np.eye(6), there @ far))) == 2


@pytest.mark.long
def test_a_right_place_is_not_taken_back() -> None:
    frames, poses = sequence(60, 1.5)
    stamps = [int(i * 1e9 / 30) for i in range(len(frames))]
    odometry = RgbdOdometry(camera())
    for i in range(25):
        odometry.track(*frames[i], stamps[i])
    odometry.state = at_a_wrong_place(odometry.state, odometry.state.map.keyframes[-1].stamp, np.eye(4))
    results = [odometry.track(*frames[i], stamps[i]) for i in range(25, 60)]
    assert {(r.status, r.taken_back) for r in results} == {(Status.TRACKING, None)}
    assert largest_errors(results, poses[25:])[0] < 0.03


def in_the_dark(shown: list[NDArray[np.float64]], config: RgbdOdometryConfig | None = None) -> RgbdOdometry:
    """An odometry of ten frames a second that was blind from 0.5 to 1.3 s, and then was shown views from poses."""
    frames, _ = sequence(25, 3.0)
    odometry = RgbdOdometry(camera(), config)
    for i in range(6):
        odometry.track(*frames[i], i * TENTH)
    assert odometry.track(*black(without_depth(frames[6])), 12 * TENTH).status is Status.LOST
    for i, T in enumerate(shown):
        odometry.track(*view(T), (13 + i) * TENTH)
    return odometry


AROUND = se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))


def test_a_new_map_begins_elsewhere_and_is_forgotten_when_the_old_one_is_seen_again() -> None:
    """The camera is turned to the other side of the room while it sees nothing, and back at once later."""
    frames, poses = sequence(25, 3.0)
    odometry = in_the_dark([])
    away = [view(AROUND @ T) for T in poses[:3]]
    results = [odometry.track(*frame, (13 + i) * TENTH) for i, frame in enumerate(away)]
    assert [(r.status, r.keyframe) for r in results[:2]] == [(Status.LOST, True), (Status.LOST, False)]
    assert results[0].reason == "nothing here is in the map: a new one begins"
    assert results[2].reason.endswith("; a new map, its place in the old one unknown")
    assert {k.segment for k in odometry.state.map.keyframes} == {0, 1}
    assert np.sqrt(results[-1].covariance[0, 0]) > 0.3
    moved = invert(results[0].T_world_camera) @ results[2].T_world_camera
    assert np.abs(se3.log(invert(invert(poses[0]) @ poses[2]) @ moved)).max() < 0.02

    back = [odometry.track(*frames[i], (12 + i) * TENTH) for i in (4, 5)]

    assert [r.status for r in back] == [Status.RELOCALISED, Status.TRACKING]
    assert "the map found again by" in back[0].reason
    assert largest_errors(back, poses[4:6])[0] < 0.02
    assert np.sqrt(back[-1].covariance[0, 0]) < 0.02
    assert {k.segment for k in odometry.state.map.keyframes} == {0}


def test_camera_in_a_new_map_is_tracking_after_the_give_up_time() -> None:
    _, poses = sequence(25, 3.0)
    odometry = in_the_dark([AROUND @ T for T in poses[:2]], RgbdOdometryConfig(give_up_s=0.2))
    T = AROUND @ poses[2]
    result = odometry.track(*view(T), 15 * TENTH)
    assert result.status is Status.TRACKING
    assert result.reason.endswith("; a new map, its place in the old one unknown")


def test_new_map_is_aligned_when_a_view_is_recognised_in_the_old_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For three frames nothing is recognised, so a new map begins where the camera is believed to be, a metre off."""
    frames, poses = sequence(25, 3.0)
    monkeypatch.setattr(tracker, "recognised", lambda *_: iter(()))
    monkeypatch.setattr(tracker, "believed", lambda *_: None)
    odometry = in_the_dark([poses[i] for i in (13, 14, 15)])
    off = se3.exp(np.array([0.6, 0.4, -0.8, 0.0, 0.3, 0.0]))
    odometry.state = replace(at_a_wrong_place(odometry.state, 13 * TENTH, off), trials=())
    monkeypatch.undo()

    results = [odometry.track(*frames[i], i * TENTH) for i in (16, 17)]

    assert [r.status for r in results] == [Status.RELOCALISED, Status.TRACKING]
    assert largest_errors(results, poses[16:18])[0] < 0.02
    for k in odometry.state.map.keyframes:
        assert k.segment == 0
        assert np.linalg.norm((k.T_world_camera - poses[k.stamp // TENTH])[:3, 3]) < 0.02


def keyframes_of(frames: list[Frame]) -> list[int]:
    return [i for i, r in enumerate(follow(frames, rate=10.0)) if r.keyframe]


def test_a_keyframe_is_made_whenever_the_view_has_changed_by_a_tenth_of_a_radian() -> None:
    def turning(step: float) -> list[Frame]:
        poses = [se3.exp(np.array([0, 0, 0, 0, step * i, 0])) for i in range(9)]
        noise = np.random.default_rng(1).normal(0, 1, (9, SIZE[1], SIZE[0]))
        seen = [view(T) for T in poses]
        return [(np.clip(g + n, 0, 255).astype(np.uint8), d) for (g, d), n in zip(seen, noise, strict=True)]

    assert keyframes_of(turning(0.03)) == [0, 4, 8]
    assert keyframes_of(turning(0.0)) == [0]


def test_view_with_depth_replaces_a_keyframe_with_little_only() -> None:
    frames, _ = sequence(25)
    narrow = [(g, np.where(np.arange(SIZE[0]) > 0.3 * SIZE[0], np.float32(0), d)) for g, d in frames]
    assert keyframes_of([narrow[0], *frames[1:4]])[:2] == [0, 1]
    turned, _ = sequence(25, 3.0)
    poor = [(g, np.where(np.arange(SIZE[0]) > 0.45 * SIZE[0], np.float32(0), d)) for g, d in turned]
    assert keyframes_of([*turned[:1], *poor[1:4], *turned[4:6]]) == [0, 4]


def test_default_parameters_equal_the_default_settings() -> None:
    assert VisualOdometry()._config() == RgbdOdometryConfig()


@pytest.mark.long
def test_relocalization_in_a_separate_map_leaves_the_old_map_lost() -> None:
    frames, poses = sequence(60, 1.5)
    turned = se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))
    shown = [*poses[:20], *poses[45:48]]
    elsewhere = [view(turned @ T) for T in shown]
    blind = [black(without_depth(frames[0]))] * 20
    back = follow([*frames[:10], *blind, *elsewhere[:20], *blind, *elsewhere[20:]])[-3:]

    assert "again" in back[0].reason
    for result in back:
        assert result.status is Status.LOST
        assert result.reason.endswith("a new map, its place in the old one unknown")
        assert np.sqrt(np.trace(result.covariance[:3, :3])) > 0.3


def mover_sequence(count: int) -> Sequence:
    """A wall-like body in front of a third of the view slides sideways by 4 cm a frame while the camera sways."""
    frames, poses = sequence(count, 3.0)
    moved = []
    for i, (gray, depth) in enumerate(frames):
        left = 20 + 3 * i
        body = np.zeros(depth.shape, bool)
        body[20:230, left : left + 110] = True
        pattern = np.roll(TEXTURE[300:540, 200:520], 9 * i, axis=1)
        bulge = 0.7 + 0.0004 * (np.arange(320, dtype=np.float32) - left - 55) ** 2 / 10
        moved.append((np.where(body, pattern, gray), np.where(body, bulge[None, :], depth).astype(np.float32)))
    return moved, poses


@pytest.mark.long
def test_moving_object_does_not_disturb_the_pose() -> None:
    frames, poses = mover_sequence(25)
    results = follow(frames, rate=10.0)
    steps = [
        float(np.linalg.norm(se3.log(invert(invert(poses[i]) @ poses[i + 1]) @ moved)[:3]))
        for i, moved in enumerate(invert(a.T_world_camera) @ b.T_world_camera for a, b in pairwise(results))
    ]
    assert max(steps) < 0.015
    assert largest_errors(results, poses)[0] < 0.03


@pytest.mark.long
def test_keyframes_exclude_moving_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = mover_sequence(25)
    odometry, fits = RgbdOdometry(camera()), []
    refine = Fitter.refine

    def noted(*given: Any) -> Fit:
        fits.append(refine(*given))
        return fits[-1]

    monkeypatch.setattr(Fitter, "refine", noted)
    left_out = 0
    for i, frame in enumerate(frames):
        result = odometry.track(*frame, i * 100_000_000)
        if not result.keyframe or not fits or not fits[-1].movers.tiles.any():
            continue
        kept = odometry.state.map.keyframes[-1].surface
        assert not fits[-1].movers.hold(kept.points()).any()
        left_out += 1
    assert left_out > 0


def test_a_surface_without_moving_tiles_keeps_the_others() -> None:
    surface = Surface(np.full((20, 30), 0.5, np.float32), K_DEPTH)
    assert Movers.none(K_DEPTH, (20, 30)).left_out_of(surface) is surface
    tiles = np.zeros((3, 4), np.bool_)
    tiles[0, 1] = tiles[2, 3] = True

    left = Movers(tiles, K_DEPTH).left_out_of(surface).inverse_depth

    assert not left[:8, 8:16].any()
    assert not left[16:, 24:].any()
    assert np.count_nonzero(left) == 20 * 30 - 8 * 8 - 4 * 6
    assert surface.inverse_depth.all()


def test_bare_wall_keeps_its_distance_and_admits_the_rest() -> None:
    """Grey wall: depth measures one translation and two rotations; the covariance must say so."""
    wall = (np.full((240, 320), 128, np.uint8), np.full((240, 320), 1.5, np.float32))
    nearer = [(wall[0], wall[1] - np.float32(0.005 * i)) for i in range(20)]
    results = follow(nearer)
    assert {r.status for r in results[6:]} <= {Status.PREDICTED, Status.LOST}
    T = results[10].T_world_camera
    assert T[2, 3] == pytest.approx(0.05, abs=0.005)
    assert np.isfinite(results[-1].T_world_camera).all()
    sigma = np.sqrt(np.diag(results[10].covariance))
    assert sigma[0] > 0.05


@pytest.mark.long
def test_a_start_in_the_dark_costs_no_more_than_the_dark() -> None:
    frames, poses = sequence(40)
    results = follow([black(without_depth(f)) if i < 5 else f for i, f in enumerate(frames)])
    assert {r.status for r in results[:5]} == {Status.LOST}
    assert results[5].reason == "the first view"
    assert all(r.status is Status.TRACKING for r in results[7:])
    moved = invert(results[5].T_world_camera) @ results[39].T_world_camera
    assert np.abs(se3.log(invert(invert(poses[5]) @ poses[39]) @ moved)).max() < 0.01


def test_nothing_ever_seen_stays_put() -> None:
    nothing = (np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.float32))
    results = follow([nothing] * 10)
    for r in results:
        np.testing.assert_array_equal(r.T_world_camera, np.eye(4))


def test_depth_out_of_range_is_not_used() -> None:
    frames, _ = sequence(40)
    far = [(g, np.where(d > 1.9, np.float32(60.0), d)) for g, d in frames[:10]]
    none = [(g, np.where(d > 1.9, np.float32(0.0), d)) for g, d in frames[:10]]
    assert digest(follow(far)) == digest(follow(none))


GREY, DEPTH = np.zeros((240, 320), np.uint8), np.ones((240, 320), np.float32)


@pytest.mark.parametrize(
    ("image", "depth", "stamp", "message"),
    [
        (np.zeros((240, 320, 4), np.uint8), DEPTH, 5, "image must be"),  # RGBA
        (GREY.astype(np.float32), DEPTH, 5, "image must be"),
        (GREY, DEPTH.astype(np.uint16), 5, "depth must be"),  # raw
        (GREY, DEPTH[..., None], 5, "depth must be"),  # extra axis
        (GREY, DEPTH[:31], 5, "depth must be at least 32 x 32"),
        (GREY[::2, ::2], DEPTH, 5, "sizes changed"),
        (GREY, DEPTH, 0, "does not follow"),  # same stamp
    ],
)
def test_wrong_input_is_refused(image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int, message: str) -> None:
    odometry = RgbdOdometry(camera())
    odometry.track(GREY, DEPTH, 0)
    with pytest.raises(ValueError, match=message):
        odometry.track(image, depth, stamp)


# -- determinism and state -----------------------------------------------------------------------------------


@pytest.mark.long
def test_same_frames_give_the_same_bytes_in_another_process_after_random_draws(repository: Path) -> None:
    script = (
        "import cv2, importlib.util as u, numpy, sys; sys.path.insert(0, 'tests/support');"
        "cv2.setRNGSeed(12345); numpy.random.seed(5);"
        f"s=u.spec_from_file_location('rendered', {__file__!r});"
        "m=u.module_from_spec(s);s.loader.exec_module(m);"
        "print(m.digest(m.follow(m.sequence(25, 3.0)[0][:12])))"
    )
    other = subprocess.run([sys.executable, "-c", script], cwd=repository, capture_output=True, text=True, check=True)
    assert other.stdout.strip() == digest(follow(sequence(25, 3.0)[0][:12]))


def test_results_are_not_views_of_the_state() -> None:
    frames, _ = sequence(40)
    odometry = RgbdOdometry(camera())
    odometry.track(*frames[0], 0).T_world_camera[:] = 7.0
    assert np.abs(odometry.track(*frames[1], 33_000_000).T_world_camera).max() < 1.1


# -- the operator --------------------------------------------------------------------------------------------


def messages(count: int) -> tuple[list[Image], list[DepthImage]]:
    """The first images and depth images of the sequence of 40 frames, at 30 Hz."""
    frames, stamps = sequence(40)[0][:count], [k * 33_000_000 for k in range(count)]
    return (
        [Image(stamp=t, frame="color", data=image) for t, (image, _) in zip(stamps, frames, strict=True)],
        [DepthImage(stamp=t, frame="depth", data=depth) for t, (_, depth) in zip(stamps, frames, strict=True)],
    )


def info(frame: str, K: NDArray[np.float64]) -> CameraInfo:
    return CameraInfo(stamp=0, frame=frame, width=SIZE[0], height=SIZE[1], K=K)


def test_operator_gives_the_core_poses_in_named_frames() -> None:
    operator, core = VisualOdometry(odometry_frame="start"), RgbdOdometry(camera())
    operator.setup()
    for image, depth in zip(*messages(5), strict=True):
        sent = operator.process(image, depth, info("color", K_COLOR), info("depth", K_DEPTH))
        out, status, told = sent["odometry"], sent["status"], core.track(image.data, depth.data, image.stamp)
        assert (out.stamp, out.frame, out.child_frame) == (image.stamp, "start", "depth")
        assert (status.stamp, status.messages) == (image.stamp, (f"tracking: {told.reason}",))
        np.testing.assert_allclose(out.matrix(), told.T_world_camera, atol=1e-12)
    assert out.pose_covariance is not None


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    calibration = info("color", K_COLOR), info("depth", K_DEPTH)
    assert_resumes_alike(VisualOdometry, [(*pair, *calibration) for pair in zip(*messages(30), strict=True)], 20)


@pytest.mark.long
def test_repeated_calibration_is_the_same_and_another_is_refused() -> None:
    images, depths = messages(8)
    given = {"image": images, "depth": depths, "image_info": [info("color", K_COLOR)]}
    given |= {"depth_info": [info("depth", K_DEPTH)]}
    other = info("depth", np.diag([1.1, 1.1, 1.0]) @ K_DEPTH)
    assert_one_calibration(VisualOdometry, given, ["image_info", "depth_info"], "depth", other, 5)


def test_clock_reset_starts_a_new_trajectory() -> None:
    operator, calibration = VisualOdometry(), (info("color", K_COLOR), info("depth", K_DEPTH))
    operator.setup()
    *first, last = zip(*messages(13)[:2], strict=True)
    for image, depth in first[::3]:
        sent = operator.process(image, depth, *calibration)
    assert np.linalg.norm(sent["odometry"].position) > 0.02
    assert operator.summary() == {"tracking": 4}
    operator.on_reset("image")
    sent = operator.process(*(message.replace(stamp=5) for message in last), *calibration)
    np.testing.assert_array_equal(sent["odometry"].matrix(), np.eye(4))
    assert sent["status"].messages == ("tracking: the first view",)


def test_images_that_repeat_the_last_ones_are_named_and_not_used() -> None:
    frames, poses = sequence(25, 3.0)
    (image, depth), (_, later) = frames[1:3]
    shown = [frames[0], (image, depth), (image, later), (image, later), frames[4], (frames[5][0], frames[4][1])]
    results = follow(shown, rate=10.0)
    assert [r.reason.split("; ", 1)[-1] for r in results[2:4]] == [
        "image repeats the last one",
        "depth repeats the last one",
    ]
    assert [r.status for r in results[2:4]] == [Status.TRACKING, Status.PREDICTED]
    assert results[5].reason.endswith("; depth repeats the last one")
    assert largest_errors(results[4:], poses[4:6])[0] < 0.02
    assert np.linalg.norm((results[2].T_world_camera - poses[2])[:3, 3]) < 0.01


def test_operator_refuses_an_image_that_its_calibration_does_not_describe() -> None:
    (image,), (depth,) = messages(1)
    small = image.replace(data=np.ascontiguousarray(image.data[::2, ::2]))
    with pytest.raises(ValueError, match="160x120"):
        VisualOdometry().process(small, depth, info("color", K_COLOR), info("depth", K_DEPTH))


# -- recorded data -------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.data
def test_recorded_sequence_is_followed_within_2_5_cm(data_dir: Path) -> None:
    from evo.core.metrics import APE, PoseRelation, StatisticsType
    from evo.core.trajectory import PosePath3D

    folder = data_dir / "rgbd_7scenes"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    K_depth = np.loadtxt(folder / "camera-intrinsics.txt")
    K_color = np.array([[525.0, 0.0, 320.0], [0.0, 525.0, 240.0], [0.0, 0.0, 1.0]])
    odometry = RgbdOdometry(RgbdCamera(K_color, K_depth))
    estimate, truth = [], []
    for i, file in enumerate(sorted(folder.glob("*.color.jpg"))):
        stem = file.name.split(".")[0]
        millimetres = cv2.imread(str(folder / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED)
        depth = np.where(millimetres == 65535, 0, millimetres).astype(np.float32) / np.float32(1000)
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        estimate.append(odometry.track(image, depth, int(i * 1e9 / 30)).T_world_camera)
        truth.append(se3.orthonormalised(np.loadtxt(folder / f"{stem}.pose.txt")))
    reference, path = PosePath3D(poses_se3=truth), PosePath3D(poses_se3=estimate)
    path.align(reference)
    ape = APE(PoseRelation.translation_part)
    ape.process_data((reference, path))
    assert ape.get_statistic(StatisticsType.rmse) <= 0.025
