"""Stereo odometry against a rendered street with known motion, against failures, and against recorded data."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_hallway import RIG, SIZE, Gray, K, Matrix, Pair, driving, sequence
from numpy.typing import NDArray
from operator_runs import assert_resumes_alike, largest_errors

from dataflow.messages import CameraInfo, Image
from dataflow.messages.geometry import invert, transform_points
from operators.estimation.bundle import Sightings
from operators.geometry import se3
from operators.geometry.pinhole import Points, project
from operators.odometry import StereoVisualOdometry
from operators.odometry.stereo.adjustment import Offset, Past, adjust, fitting
from operators.odometry.stereo.odometry import rig_of
from operators.odometry.stereo.relocalizer import RelocalizedPose, StereoKeyframe, StereoRelocalizer, kept_pair
from operators.odometry.stereo.settings import StereoOdometryConfig
from operators.odometry.stereo.tracker import StereoOdometry
from operators.odometry.tracking import Status, TrackResult
from operators.sources import KittiOdometry


def follow(pairs: list[Pair]) -> list[TrackResult]:
    odometry = StereoOdometry(RIG)
    return [odometry.track(left, right, i * 100_000_000) for i, (left, right) in enumerate(pairs)]


# -- accuracy ------------------------------------------------------------------------------------------------


def test_pose_follows_known_motion() -> None:
    pairs, poses = sequence(25)
    results = follow(pairs)
    assert {r.status for r in results} == {Status.TRACKING}
    position, rotation = largest_errors(results, poses)
    assert position < 0.05  # of ten metres
    assert rotation < 0.005


@pytest.mark.long
@pytest.mark.parametrize("shift", [0.33, 2.0])
def test_disparities_that_are_off_by_a_constant_do_not_stretch_the_way(shift: float) -> None:
    """The right image is shifted, as an imperfect rectification leaves it: 2 px are a fifth of what is 15 m away."""
    pairs, poses = sequence(25)
    right = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
    shifted = [(a, cv2.warpAffine(b, right, SIZE, borderMode=cv2.BORDER_REPLICATE)) for a, b in pairs]
    odometry = StereoOdometry(RIG)
    results = [odometry.track(left, right, i * 100_000_000) for i, (left, right) in enumerate(shifted)]
    assert odometry.state.offset.pixels == pytest.approx(shift, abs=0.15)
    late = np.linalg.norm(results[-1].T_world_camera[:3, 3] - results[12].T_world_camera[:3, 3])
    truth = np.linalg.norm(poses[-1][:3, 3] - poses[12][:3, 3])
    assert late == pytest.approx(truth, rel=0.01)
    assert largest_errors(results, poses)[0] < 0.05  # of ten metres: the first windows show the offset


def test_points_at_infinity_give_no_corner_whatever_the_offset() -> None:
    """The images are shifted by what the offset is known to be: nothing in them has a depth."""
    (left, _), odometry = sequence(25)[0][0], StereoOdometry(RIG, StereoOdometryConfig(min_disparity=0.5))
    odometry.state = replace(odometry.state, offset=Offset(-1.0))
    result = odometry.track(left, np.roll(left, -1, axis=1), 0)
    assert (result.status, result.reason) == (Status.LOST, "0 corners seen by both")


def test_no_part_of_the_window_holds_the_length_that_a_wrong_offset_gave_it() -> None:
    """Poses and points are 2 % too far, as by an offset of 0.4 px unknown when they were measured."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-5, 5, 60), rng.uniform(-2, 2, 60), rng.uniform(8, 40, 60)])
    poses = np.array(driving(8))
    frames, indices = (a.ravel() for a in np.meshgrid(np.arange(8), np.arange(60), indexing="ij"))
    pixels = np.concatenate([RIG.project((points - T[:3, 3]) @ T[:3, :3]) for T in poses])
    pixels[:, 2] += 0.4
    stretched, offset = poses.copy(), Offset()
    stretched[:, :3, 3] *= 1.02
    found, far = stretched, points * 1.02
    for _ in range(30):  # an offset is believed slowly
        adjusted = adjust(
            RIG,
            found,
            far,
            Sightings(frames, indices, pixels),
            offset,
            Past.none(found, offset.pixels),
            0.3,
            StereoOdometryConfig().fixed,
            4,
        )
        found, far, offset = adjusted.poses, adjusted.points, adjusted.offset
    lengths = np.diff(found[:, 2, 3]) / np.diff(poses[:, 2, 3])
    assert offset.pixels > 0.2
    assert lengths.max() < 1.016  # every step has got shorter, none holds what was believed at first
    assert np.ptp(lengths) < 0.003


def test_window_informs_the_offset_by_its_motion() -> None:
    """A camera that stands still cannot tell near points of one offset from farther ones of another."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-5, 5, 60), rng.uniform(-2, 2, 60), rng.uniform(8, 40, 60)])
    frames, indices = (a.ravel() for a in np.meshgrid(np.arange(8), np.arange(60), indexing="ij"))
    learnt = {}
    for name, poses in {"standing": np.array([np.eye(4)] * 8), "driving": np.array(driving(8))}.items():
        pixels = np.concatenate([RIG.project((points - T[:3, 3]) @ T[:3, :3]) for T in poses])
        found = adjust(
            RIG, poses, points, Sightings(frames, indices, pixels), Offset(), Past.none(poses, 0.0), 0.3, 1, 4
        )
        learnt[name] = found.offset.information - Offset().information
    assert learnt["standing"] < 0.01 * learnt["driving"]


def test_adjustment_finds_poses_and_points_again() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-5, 5, 60), rng.uniform(-2, 2, 60), rng.uniform(6, 25, 60)])
    poses = np.array(driving(5))
    frames, indices = (a.ravel() for a in np.meshgrid(np.arange(5), np.arange(60), indexing="ij"))
    pixels = np.concatenate([RIG.project((points - T[:3, 3]) @ T[:3, :3]) for T in poses])
    off = np.array([T @ se3.exp(rng.normal(0, 0.01, 6)) if i else T for i, T in enumerate(poses)])
    seen = Sightings(frames, indices, pixels)
    found = adjust(RIG, off, points + rng.normal(0, 0.1, points.shape), seen, Offset(), Past.none(off, 0.0), 0.3, 1, 10)
    np.testing.assert_allclose(found.poses, poses, atol=1e-3)
    np.testing.assert_allclose(found.points, points, atol=2e-2)
    assert found.offset.pixels == pytest.approx(0.0, abs=1e-2)


def test_points_that_are_gone_still_hold_the_window() -> None:
    """The oldest of six frames shares nothing with the others but four points 70 m away; what was near is behind."""
    rng = np.random.default_rng(1)
    poses = np.array(driving(6))
    near = np.column_stack([rng.uniform(-4, 4, 40), rng.uniform(-1, 1, 40), rng.uniform(6, 20, 40)])
    far = np.column_stack([rng.uniform(-20, -18, 4), rng.uniform(-2, 2, 4), rng.uniform(68, 72, 4)])

    def seen(points: Points, frames: NDArray[np.int64]) -> Sightings:
        every = np.repeat(frames, len(points))
        local = np.concatenate([transform_points(invert(poses[k]), points) for k in frames])
        return Sightings(
            every, np.tile(np.arange(len(points)), len(frames)), RIG.project(local) + rng.normal(0, 0.3, local.shape)
        )

    ahead = near + np.array([0.0, 0.0, 8.0])
    gone, later, all_along = seen(near, np.arange(3)), seen(ahead, np.arange(2, 6)), seen(far, np.arange(6))
    here = Sightings(
        np.concatenate([later.frames, all_along.frames]),
        np.concatenate([later.points, all_along.points + len(near)]),
        np.concatenate([later.pixels, all_along.pixels]),
    )
    points, off = np.concatenate([ahead, far]), dict[str, float]()
    for name, past in {
        "forgotten": Past.none(poses, 0.0), "held": Past.none(poses, 0.0).also(RIG, near, gone, 0.3)
    }.items():  # fmt: skip
        found = adjust(RIG, poses, points, here, Offset(), past, 0.3, 1, 10)
        off[name] = float(np.linalg.norm((invert(poses[-1]) @ found.poses[-1])[:3, 3]))
    assert off["forgotten"] > 0.5
    assert off["held"] < 0.1


def test_marginalizing_the_first_pose_keeps_the_information_on_the_others() -> None:
    """The last poses are as sure of each other as with the first one beside them."""
    rng = np.random.default_rng(2)
    poses = np.array(driving(4))
    points = np.column_stack([rng.uniform(-4, 4, 40), rng.uniform(-1, 1, 40), rng.uniform(6, 20, 40)])
    frames, indices = (a.ravel() for a in np.meshgrid(np.arange(4), np.arange(40), indexing="ij"))
    pixels = np.concatenate([RIG.project(transform_points(invert(T), points)) for T in poses])
    whole = Past.none(poses, 0.0).also(RIG, points, Sightings(frames, indices, pixels), 0.3)
    rest = whole.without_first()
    held = whole.H + np.diag([0.0] * 6 + [1e8] * 6 + [0.0] * 13)  # all given the second pose
    expected = np.linalg.inv(held)[12:, 12:]
    np.testing.assert_allclose(np.linalg.inv(rest.H[6:, 6:]), expected, rtol=0.02, atol=1e-7)


def test_a_point_is_seen_where_the_rig_projects_it_and_found_again_from_there() -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-2, 2, (20, 2)), rng.uniform(3, 30, 20)])
    left, right = project(points, K), project(points - [RIG.baseline, 0.0, 0.0], K)
    np.testing.assert_allclose(RIG.project(points), np.column_stack([left, right[:, 0]]))
    np.testing.assert_allclose(RIG.triangulate(RIG.project(points)), points)
    steps = 1e-6 * np.eye(3)
    expected = np.stack([(RIG.project(points + d) - RIG.project(points - d)) / 2e-6 for d in steps], axis=-1)
    np.testing.assert_allclose(RIG.jacobian(points), expected, atol=1e-6, rtol=1e-6)


def test_sightings_are_kept_by_point_and_go_with_their_frame() -> None:
    one = Sightings.none(3).also(0, np.array([0, 2]), np.full((2, 3), 1.0))
    two = one.also(1, np.array([1, 2]), np.full((2, 3), 2.0))
    some = two.of_points(np.array([2, 0]))
    assert (some.frames.tolist(), some.points.tolist()) == ([0, 0, 1], [1, 0, 0])
    assert some.pixels[:, 0].tolist() == [1.0, 1.0, 2.0]
    later = two.without_first()
    assert (later.frames.tolist(), later.points.tolist(), later.pixels[:, 0].tolist()) == ([0, 0], [1, 2], [2.0, 2.0])
    squared = np.array([3.0, 14.0, 14.0, 9.0])  # of points 0, 2, 1, 2
    assert fitting(two, squared, 4).tolist() == [True, False, True, False]


def test_pose_information_relinearizes_at_nearby_poses() -> None:
    """The gradient of a sum of squares at another place, to first order; a pose that is new is free."""
    poses, rng = np.array(driving(2)), np.random.default_rng(4)
    H = rng.normal(size=(13, 13))
    known = replace(Past.none(poses, 0.1), H=H @ H.T)
    x = rng.normal(0, 1e-3, 13)
    moved = np.array([T @ se3.exp(d) for T, d in zip(poses, x[:12].reshape(2, 6), strict=True)])
    there = known.at(moved, 0.1 + x[12])
    np.testing.assert_allclose(there.gradient, H @ H.T @ x, atol=1e-9)
    more = there.with_pose(np.eye(4))
    free = np.r_[0:12, 18]
    assert (len(more.poses), np.count_nonzero(more.H[12:18])) == (3, 0)
    np.testing.assert_array_equal(more.H[np.ix_(free, free)], there.H)
    np.testing.assert_array_equal(more.gradient[free], there.gradient)


# -- failures ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_black_and_frozen_images_are_noticed_and_bridged() -> None:
    pairs, poses = sequence(25)
    dark = (np.zeros_like(pairs[0][0]), pairs[0][1])
    results = follow([dark if 10 <= i < 12 else pair for i, pair in enumerate(pairs)])
    assert [r.status for r in results[10:12]] == [Status.PREDICTED] * 2
    assert results[10].reason == "left image is black"
    assert results[12].status is Status.TRACKING
    assert largest_errors(results[12:], poses[12:])[0] < 0.1
    frozen = follow([*pairs[:10], pairs[9]])
    assert frozen[10].reason == "left image repeats the last one; right image repeats the last one"


@pytest.mark.long
def test_long_darkness_is_a_loss_with_a_large_covariance() -> None:
    pairs, poses = sequence(25)
    dark = (np.zeros_like(pairs[0][0]),) * 2
    results = follow([dark if 5 <= i < 15 else pair for i, pair in enumerate(pairs)])
    assert results[14].status is Status.LOST
    sigmas = [np.sqrt(np.trace(r.covariance[:3, :3])) for r in results[4:15]]
    assert all(b > a for a, b in pairwise(sigmas))
    last = invert(results[18].T_world_camera) @ results[24].T_world_camera
    assert np.linalg.norm(se3.log(invert(invert(poses[18]) @ poses[24]) @ last)[:3]) < 0.05


@pytest.mark.parametrize("tracked", [True, False], ids=["while it is tracked", "while it is dark"])
def test_a_new_map_begins_after_a_gap_and_goes_where_the_view_is_found(
    tracked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is found is given here: nothing for three frames, and then the place."""
    pairs, poses = sequence(25)
    dark, found = (np.zeros_like(pairs[0][0]),) * 2, list[RelocalizedPose]()
    monkeypatch.setattr(StereoRelocalizer, "found", lambda *_: iter(found))
    monkeypatch.setattr(StereoRelocalizer, "believed", lambda *_: False)
    odometry = StereoOdometry(RIG)
    for i in range(4):
        assert odometry.track(*pairs[i], i * 100_000_000).status is Status.TRACKING
    assert odometry.track(*dark, 1_200_000_000).status is Status.LOST
    apart = [odometry.track(*pairs[i], i * 100_000_000) for i in (14, 15, 16)]
    assert {r.status for r in apart} == {Status.LOST}
    assert apart[0].reason.endswith(": a new map begins")
    assert apart[2].reason.endswith("corners; a new map, its place in the old one unknown")
    assert {k.segment for k in odometry.state.map.keyframes} == {0, 1}
    assert np.linalg.norm((apart[2].T_world_camera - poses[16])[:3, 3]) > 0.5
    if not tracked:
        odometry.track(*dark, 2_400_000_000)

    later = 1_700_000_000 if tracked else 2_500_000_000
    known = odometry.state.map.keyframes[0]
    found.append(RelocalizedPose(poses[17], 1e-4 * np.eye(6), 999, known))
    back = odometry.track(*pairs[17], later)
    found.clear()
    after = odometry.track(*pairs[18], later + 100_000_000)

    assert (back.status, back.reason) == (Status.RELOCALISED, "the map found again by 999 features")
    assert (after.status, odometry.state.map.apart_since) == (Status.TRACKING, None)
    assert largest_errors([back, after], poses[17:19])[0] < 0.1
    assert np.sqrt(np.trace(after.covariance[:3, :3])) < 0.2 < np.sqrt(np.trace(apart[0].covariance[:3, :3]))
    kept = odometry.state.map.keyframes
    assert {k.segment for k in kept} == {0}
    assert (14 in [k.stamp // 100_000_000 for k in kept]) == tracked
    truth = {i * 100_000_000: T for i, T in enumerate(poses[:17])} | {later: poses[17], later + 100_000_000: poses[18]}
    for k in kept:
        assert np.linalg.norm((k.T_world_camera - truth[k.stamp])[:3, 3]) < 0.1


def test_view_is_relocalized_among_kept_pairs_that_agree() -> None:
    pairs, poses = sequence(25)

    def kept(k: int, T: Matrix, segment: int = 0) -> StereoKeyframe:
        return kept_pair(*pairs[k], k, T, 1e-4 * np.eye(6), 0.0, segment)

    known, relocalizer = [kept(k, poses[k]) for k in (0, 4, 8)], StereoRelocalizer(RIG)
    ahead = se3.exp(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    assert relocalizer.believed(kept(6, poses[6]), known, 4.0)
    assert not relocalizer.believed(kept(6, poses[6] @ ahead), known, 4.0)
    assert not relocalizer.believed(kept(6, poses[6], segment=1), known, 4.0)  # of which no pair was kept
    (found,) = relocalizer.found(kept(6, np.eye(4)), known, known, 4.0)
    assert np.linalg.norm((invert(poses[6]) @ found.T_world_camera)[:3, 3]) < 0.1
    assert any(found.keyframe is each for each in known)
    assert found.features >= 15
    assert 1e-3 < np.sqrt(np.trace(found.covariance[:3, :3])) < 0.2


def test_blank_images_give_no_pose() -> None:
    blank = (np.full((200, 480), 90, np.uint8),) * 2
    assert {r.status for r in follow([blank] * 3)} <= {Status.LOST, Status.PREDICTED}


@pytest.mark.parametrize(
    ("left", "right", "stamp", "message"),
    [
        (np.zeros((200, 480), np.float32), np.zeros((200, 480), np.uint8), 5, "left must be"),  # float
        (np.zeros((200, 480), np.uint8), np.zeros((100, 480), np.uint8), 5, "differ in size"),  # other size
        (np.zeros((200, 480), np.uint8), np.zeros((200, 480), np.uint8), 0, "does not follow"),  # same stamp
    ],
)
def test_wrong_input_is_refused(left: Gray, right: Gray, stamp: int, message: str) -> None:
    odometry = StereoOdometry(RIG)
    odometry.track(*sequence(25)[0][0], 0)
    with pytest.raises(ValueError, match=message):
        odometry.track(left, right, stamp)


def test_wrong_calibration_is_refused() -> None:
    left, right = infos()
    with pytest.raises(ValueError, match="P"):
        rig_of(left, left.replace(P=None))
    with pytest.raises(ValueError, match="one K"):
        rig_of(left.replace(P=None, K=K * [[2.0], [2.0], [1.0]]), right)


# -- the operator -----------------------------------------------------------------------------------------


def infos() -> tuple[CameraInfo, CameraInfo]:
    P = np.column_stack([K, [-K[0, 0] * RIG.baseline, 0.0, 0.0]])
    left = CameraInfo(stamp=0, frame="left", width=SIZE[0], height=SIZE[1], K=K, P=np.column_stack([K, np.zeros(3)]))
    return left, CameraInfo(stamp=0, frame="right", width=SIZE[0], height=SIZE[1], K=K, P=P)


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    pairs, _ = sequence(25)
    firings = [
        (*(Image(stamp=i * 100_000_000, frame=f, data=d) for f, d in (("left", left), ("right", right))), *infos())
        for i, (left, right) in enumerate(pairs[:15])
    ]
    assert assert_resumes_alike(StereoVisualOdometry, firings, 10).summary() == {"tracking": 15}


# -- recorded data -------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.data
def test_recorded_drive_is_followed_within_one_percent(data_dir: Path) -> None:
    folder = data_dir / "kitti_odometry_06"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    source = KittiOdometry(path=str(folder), stop=21)
    source.setup()
    statics = source.static_outputs()
    odometry = StereoOdometry(rig_of(statics["left_info"], statics["right_info"]))
    for step in source.stream():
        result = odometry.track(step["left"].data, step["right"].data, step["left"].stamp)
        assert result.status is Status.TRACKING
        way = step["ground_truth"].matrix()[:3, 3]
    assert np.linalg.norm(result.T_world_camera[:3, 3]) == pytest.approx(np.linalg.norm(way), rel=0.02)
