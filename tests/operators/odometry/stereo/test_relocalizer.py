"""A stereo camera that was blind: its place is found again, or said to be unknown, in a made hallway."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_hallway import RIG, SIZE, Matrix, Pair, driving, pairs_at

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages.geometry import invert
from dataflow.state import StateError, plain, typed
from operators.geometry import se3
from operators.odometry import StereoVisualOdometry
from operators.odometry.stereo.adjustment import StereoRig
from operators.odometry.stereo.map import StereoMap
from operators.odometry.stereo.relocalizer import StereoKeyframe, StereoRelocalizer, kept_pair
from operators.odometry.stereo.settings import StereoOdometryConfig
from operators.odometry.stereo.tracker import StereoOdometry, StereoState
from operators.odometry.tracking import MEASURED, Status, TrackResult

PERIOD = 100_000_000
DARK: Pair = (np.zeros(SIZE[::-1], np.uint8), np.zeros(SIZE[::-1], np.uint8))
GAP = 10  # frames, a second
CONFIG = StereoOdometryConfig()
AROUND = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))


def seen(poses: list[Matrix], noise: int = 3, paper: int = 4) -> list[Pair]:
    """What the rig sees in a hallway no part of which looks like another."""
    return pairs_at(poses, noise, paper, times=4)


@cache
def sequence(count: int) -> tuple[list[Pair], list[Matrix]]:
    poses = driving(count)
    return seen(poses), poses


def follow(pairs: list[Pair], config: StereoOdometryConfig | None = None) -> list[TrackResult]:
    odometry = StereoOdometry(RIG, config)
    return [odometry.track(left, right, i * PERIOD) for i, (left, right) in enumerate(pairs)]


def off(result: TrackResult, T: Matrix) -> float:
    """Metres between a pose and the true one."""
    return float(np.linalg.norm((invert(T) @ result.T_world_camera)[:3, 3]))


def aside(poses: list[Matrix]) -> list[Matrix]:
    """The same way, driven a quarter of a metre beside and looking a little to the left: no image comes again."""
    return [T @ se3.exp(np.array([0.25, 0.05, 0.0, 0.0, -0.04, 0.0])) for T in poses]


@pytest.mark.long
def test_an_old_view_after_a_gap_is_found_at_its_place() -> None:
    pairs, poses = sequence(25)
    back = aside(poses[6::-1])
    results = follow([*pairs[:18], *[DARK] * GAP, *seen(back)])
    after = results[18 + GAP :]
    assert [r.status for r in results[18 + GAP - 3 : 18 + GAP]] == [Status.LOST] * 3
    assert after[0].status is Status.RELOCALISED
    assert {r.status for r in after[1:]} == {Status.TRACKING}
    assert max(off(r, T) for r, T in zip(after, back, strict=True)) < 0.15
    assert np.sqrt(np.trace(after[0].covariance[:3, :3])) < 0.5 * np.sqrt(np.trace(results[27].covariance[:3, :3]))


@pytest.mark.long
@pytest.mark.parametrize("paper", [4, 11], ids=["the other way", "another hallway"])
def test_a_view_that_nothing_kept_shows_is_lost_and_then_apart_until_an_old_one_comes(paper: int) -> None:
    pairs, poses = sequence(25)
    config = replace(CONFIG, give_up_s=0.8)
    there = [poses[17] @ AROUND @ se3.exp(np.array([0.0, 0.0, 0.1 * k, 0.0, 0.0, 0.0])) for k in range(14)]
    away = seen(there, noise=5, paper=paper)
    back = aside(poses[8:2:-1])
    results = follow([*pairs[:18], *[DARK] * GAP, *away, *seen(back, noise=6)], config)
    unknown, after = results[18 + GAP : 18 + GAP + 14], results[18 + GAP + 14 :]
    assert Status.RELOCALISED not in [r.status for r in unknown]
    assert [r.status for r in unknown[:8]] == [Status.LOST] * 8
    assert "a new map begins" in unknown[0].reason
    assert {r.status for r in unknown[9:]} == {Status.TRACKING}
    assert all(r.reason.endswith("its place in the old one unknown") for r in unknown[9:])
    found = [k for k, r in enumerate(after) if r.status is Status.RELOCALISED]
    assert found
    assert "the map found again by" in after[found[0]].reason
    measured = [(r, T) for r, T in zip(after[found[0] :], back[found[0] :], strict=True) if r.status in MEASURED]
    assert max(off(r, T) for r, T in measured) < 0.15
    assert "unknown" not in after[-1].reason


@pytest.mark.long
def test_a_new_map_is_moved_to_where_it_belongs_when_the_old_one_is_seen() -> None:
    """It turns round in the dark, drives on, and turns back in the light: the new map then joins the old one."""
    pairs, poses = sequence(25)
    turned = [poses[17] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi - 0.12 * k, 0.0])) for k in range(27)]
    odometry = StereoOdometry(RIG)
    given = [*pairs[:18], *[DARK] * GAP, *seen(turned, noise=5)]
    results = [odometry.track(left, right, i * PERIOD) for i, (left, right) in enumerate(given)]
    assert off(results[-1], turned[-1]) < 0.2
    known = odometry.state.map
    assert known.apart_since is None
    assert {k.segment for k in known.keyframes} == {0}
    truth = dict(enumerate([*poses[:18], *[poses[17]] * GAP, *turned]))
    for k in known.keyframes:
        assert np.linalg.norm((invert(truth[k.stamp // PERIOD]) @ k.T_world_camera)[:3, 3]) < 0.3


@pytest.mark.long
def test_the_same_pairs_give_the_same_bytes_also_from_a_snapshot_in_a_new_map() -> None:
    pairs, poses = sequence(25)
    there = seen([poses[17] @ AROUND] * 3, noise=5)
    given = [*pairs[:18], *[DARK] * GAP, *there, *seen(aside(poses[8:4:-1]), noise=6)]
    first = follow(given)
    odometry, other = StereoOdometry(RIG), StereoOdometry(RIG)
    for i, (left, right) in enumerate(given[:30]):
        odometry.track(left, right, i * PERIOD)
    other.state = typed(StereoState, unpack_state(pack_state(plain(odometry.state))))
    for i, (left, right) in enumerate(given[30:], start=30):
        result = other.track(left, right, i * PERIOD)
        assert (result.status, result.reason) == (first[i].status, first[i].reason)
        assert result.T_world_camera.tobytes() == first[i].T_world_camera.tobytes()
        assert result.covariance.tobytes() == first[i].covariance.tobytes()


def test_a_state_of_a_version_without_a_map_is_refused() -> None:
    operator = StereoVisualOdometry()
    recorded = operator.snapshot()
    former = {name: value for name, value in recorded["odometry"].items() if name != "map"}
    with pytest.raises(StateError, match=r"snapshot of another version: .*StereoState\) has no map"):
        operator.restore({**recorded, "odometry": former})


# -- the pairs that are kept ---------------------------------------------------------------------------------------


def kept(T: Matrix, stamp: int, pair: Pair = DARK, segment: int = 0) -> StereoKeyframe:
    return kept_pair(*pair, stamp, T, np.zeros((6, 6)), 0.0, segment)


def test_no_more_pairs_are_kept_than_asked_for_and_the_first_and_newest_stay() -> None:
    known = StereoMap(unit=2.0)
    for k, T in enumerate(driving(20)):
        known = known.with_keyframe(kept(T, k), 8)
    stamps = [k.stamp for k in known.keyframes]
    assert len(stamps) == 8
    assert stamps[0] == 0
    assert stamps[-5:] == [15, 16, 17, 18, 19]


def test_unknown_place_starts_a_segment_and_relocalization_continues_one() -> None:
    """The place of the second is unknown while the camera is found in the first."""
    known = StereoMap(tuple(kept(np.eye(4), number, segment=number) for number in range(3)))
    joined = known.placed(known.keyframes[0], np.eye(4))
    assert [k.segment for k in joined.keyframes] == [1, 0, 0]
    assert joined.unused_segment == 2
    assert known.placed(known.keyframes[0], None).segment == 0


def test_a_new_segment_moves_as_a_whole_to_where_one_of_its_views_was_found() -> None:
    poses, T_there = driving(5), se3.exp(np.array([0.4, -0.1, 2.0, 0.0, 0.3, 0.0]))
    known = StereoMap(tuple(kept(T, k, segment=int(k > 1)) for k, T in enumerate(poses)), apart_since=3, recalls=7)
    sure = replace(known.keyframes[0], covariance=1e-4 * np.eye(6))
    assert [k.stamp for k in known.elsewhere] == [0, 1]
    assert known.unused_segment == 2

    joined = known.placed(sure, T_there)

    assert [k.segment for k in joined.keyframes] == [0] * 5
    assert (joined.apart_since, joined.recalls) == (None, 0)
    for k, T in zip(joined.keyframes, [*poses[:2], *(T_there @ T for T in poses[2:])], strict=True):
        np.testing.assert_allclose(k.T_world_camera, T, atol=1e-12)
    np.testing.assert_array_equal(joined.keyframes[-1].covariance, sure.covariance)
    here = known.placed(known.keyframes[-1], T_there)
    assert (here.keyframes, here.apart_since, here.recalls) == (known.keyframes, 3, 0)


def test_a_pair_is_due_when_the_view_has_changed_as_seen_at_the_depth_of_the_scene() -> None:
    """Things are 2 units of 5 m away, so 1 m aside is a tenth of a radian."""
    known = StereoMap(unit=5.0)
    assert known.due(np.eye(4), 0.1)
    known = known.with_keyframe(kept(np.eye(4), 0), 8)
    assert [known.due(se3.exp(np.array([x, 0, 0, 0, 0, 0])), 0.1) for x in (0.0, 0.9, 1.1)] == [False, False, True]
    assert [known.due(se3.exp(np.array([0, 0, 0, 0, a, 0])), 0.1) for a in (0.09, 0.11)] == [False, True]


@pytest.mark.parametrize("shift", [0, 6])
def test_the_depth_of_a_pair_allows_for_what_its_right_columns_are_off_by(shift: int) -> None:
    """A wall across the way, 5 m from the camera; units are 2 m. The images are kept at a third of their size."""
    wall = np.repeat(np.repeat(np.random.default_rng(0).integers(0, 255, (100, 420)).astype(np.uint8), 4, 0), 4, 1)
    disparity = round(2 * RIG.K[0, 0] * RIG.baseline / 5.0)
    left, right = (np.ascontiguousarray(wall[:, x : x + 960]) for x in (200, 200 + disparity - shift))
    large = StereoRig(RIG.K * np.array([[2.0], [2.0], [1.0]]), RIG.baseline)
    pair = kept_pair(left, right, 0, np.eye(4), np.zeros((6, 6)), float(shift), 0)
    assert (pair.factor, pair.left.shape) == (3, (133, 320))
    surface = StereoRelocalizer(large)._surface(pair, 2.0)
    assert surface.coverage > 0.5
    assert np.median(surface.points()[:, 2]) == pytest.approx(2.5, rel=0.02)


@pytest.mark.long
def test_a_pose_elsewhere_than_shape_and_brightness_say_is_not_believed() -> None:
    pairs, poses = sequence(25)
    known = [kept(poses[k], k, pairs[k]) for k in (4, 8)]
    relocalizer = StereoRelocalizer(RIG)
    assert relocalizer.believed(kept(poses[6], 6, pairs[6]), known, 4.0)
    for step in ([0.0, 0.0, 2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.2, 0.0]):
        assert not relocalizer.believed(kept(poses[6] @ se3.exp(np.array(step)), 6, pairs[6]), known, 4.0)
    other = seen([poses[6]], paper=11)[0]
    assert not relocalizer.believed(kept(poses[6], 6, other), known, 4.0)


@pytest.mark.long
@pytest.mark.parametrize("unit", [2.0, 4.0, 8.0])
def test_a_view_is_found_in_any_unit_near_to_that_of_the_scene(unit: float) -> None:
    pairs, poses = sequence(25)
    known = [kept(poses[k], k, pairs[k]) for k in (0, 4, 8, 12)]
    T = aside([poses[6]])[0]
    view = kept(np.eye(4), 99, seen([T])[0])
    found = list(StereoRelocalizer(RIG).found(view, known, known, unit))
    assert len(found) == 1
    assert np.linalg.norm((invert(T) @ found[0].T_world_camera)[:3, 3]) < 0.15
