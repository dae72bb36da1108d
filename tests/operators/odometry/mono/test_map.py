"""The map of one camera: which points it has, which keyframes it keeps, and what an adjustment takes back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.odometry.mono.map import MonoMap, View, found_in
from operators.odometry.mono.pose import refined, solved
from operators.odometry.mono.scale import FEWEST_METRES, Scale, ratio

Array = NDArray[np.float64]

K = np.array([[260.0, 0.0, 179.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
RNG = np.random.default_rng(2)
POINTS = np.column_stack([RNG.uniform(-2, 2, 60), RNG.uniform(-1.5, 1.5, 60), RNG.uniform(3, 6, 60)])
GRAY = np.zeros((240, 360), np.uint8)


def pose(k: float) -> Array:
    """A camera that goes aside by 0.2 m from keyframe to keyframe."""
    return se3.exp(np.array([0.2 * k, 0.0, 0.02 * k, 0.0, 0.01 * k, 0.0]))


def seen(T: Array, points: Array) -> Array:
    return project(transform_points(invert(T), points), K)


def view(k: int, numbers: NDArray[np.int64], given: Array | None = None) -> View:
    """A keyframe at its true place, or said to be elsewhere, that saw points by number where they are."""
    return View(k, pose(k) if given is None else given, GRAY, numbers, seen(pose(k), POINTS[numbers]))


def whole(count: int) -> MonoMap:
    """A map of all points, each seen by all keyframes."""
    every = np.arange(len(POINTS))
    return MonoMap(tuple(view(k, every) for k in range(count)), every, POINTS)


def test_numbers_are_found_where_they_are() -> None:
    rows, there = found_in(np.array([2, 5, 9]), np.array([9, 1, 5, 12, 2]))
    assert there.tolist() == [True, False, True, False, True]
    assert rows[there].tolist() == [2, 1, 0]
    assert not found_in(np.zeros(0, np.int64), np.array([3]))[1].any()


def test_points_are_added_replaced_and_removed_by_number() -> None:
    known = MonoMap((view(0, np.array([1, 2, 4])),), np.array([1, 4]), POINTS[[1, 4]])
    more = known.with_points(np.array([2, 4]), np.ones((2, 3)))
    assert more.numbers.tolist() == [1, 2, 4]
    np.testing.assert_array_equal(more.points, [POINTS[1], np.ones(3), np.ones(3)])
    less = more.without(np.array([4, 1]))
    assert less.numbers.tolist() == less.newest.numbers.tolist() == [2]
    np.testing.assert_array_equal(less.newest.pixels, known.newest.pixels[[1]])
    numbers, points, pixels = more.seen_in(view(3, np.array([4, 7])))
    assert (numbers.tolist(), points.tolist()) == ([4], [[1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(pixels, seen(pose(3), POINTS[[4]]))


def test_typical_depth_is_the_median_over_visible_points_of_the_newest_keyframe() -> None:
    points = np.array([[0, 0, 1.0], [0, 0, 2], [0, 0, 4], [0, 0, -9], [0, 0, 50]])
    newest = View(1, np.eye(4), GRAY, np.array([0, 1, 2, 3]), np.zeros((4, 2)))
    known = MonoMap((newest,), np.arange(5), points)
    assert known.typical_depth(np.eye(4)) == 2.0
    behind = np.eye(4)
    behind[2, 3] = 60.0
    assert known.typical_depth(behind) == 1.0


def test_a_full_map_forgets_an_old_keyframe_and_the_point_that_it_alone_saw() -> None:
    """The fourth is between neighbours that see nearly the same; the three of the window see it yet more nearly."""
    places = [0, 4, 8, 9, 10, 14, 14, 14]
    views = [replace(view(k, np.array([k])), T_world_camera=pose(at)) for k, at in enumerate(places)]
    before = MonoMap(tuple(views[:-1]), np.arange(8), POINTS[:8])
    full, room = before.with_view(views[-1], 7, 3), before.with_view(views[-1], 8, 3)
    assert [v.stamp for v in full.views] == full.numbers.tolist() == [0, 1, 2, 4, 5, 6, 7]
    np.testing.assert_array_equal(full.points, POINTS[full.numbers])
    assert [v.stamp for v in room.views] == room.numbers.tolist() == list(range(8))
    assert [v.stamp for v in before.with_view(views[-1], 7, 7).views] == [1, 2, 3, 4, 5, 6, 7]


def test_corners_become_points_where_their_rays_meet() -> None:
    """Those with enough parallax, before both cameras, and in both images where the point is."""
    every = np.arange(len(POINTS))
    old, newest = view(0, every[:40]), view(4, every)
    wrong = newest.pixels.copy()
    wrong[0] += [0.0, 5.0]  # off its epipolar line
    wrong[1] = 2 * seen(pose(4), POINTS[[1]] + [0, 0, 1e6])[0] - wrong[1]  # beyond infinity
    grown = MonoMap((old, replace(newest, pixels=wrong))).grown(K, 0.05, 2.0)
    assert grown.numbers.tolist() == list(range(2, 40))
    np.testing.assert_allclose(grown.points, POINTS[2:40], atol=1e-6)
    assert not len(MonoMap((old, newest)).grown(K, 0.5, 2.0).numbers)
    kept = replace(MonoMap((old, newest)), numbers=np.array([3]), points=np.zeros((1, 3))).grown(K, 0.05, 2.0)
    assert kept.points[kept.numbers.tolist().index(3)].tolist() == [0, 0, 0]


def test_an_adjustment_puts_the_newest_keyframes_and_what_they_saw_in_their_place() -> None:
    known = whole(12)
    views = list(known.views)
    for k in (9, 10, 11):
        views[k] = replace(views[k], T_world_camera=pose(k) @ se3.exp(RNG.normal(0, 0.01, 6)))
    pixels = views[11].pixels.copy()
    pixels[7] += 25.0
    views[11] = replace(views[11], pixels=pixels)
    off = MonoMap(tuple(views), known.numbers, POINTS + RNG.normal(0, 0.03, POINTS.shape))

    adjusted, wrong = off.adjusted(K, 0.7, 3, 2, 20)

    assert wrong.tolist() == [7]
    for k in range(12):
        np.testing.assert_allclose(adjusted.views[k].T_world_camera, pose(k), atol=1e-3)
    right = np.arange(len(POINTS)) != 7
    np.testing.assert_allclose(adjusted.points[right], POINTS[right], atol=5e-3)


def test_rescaled_map_keeps_its_projections() -> None:
    known, centre = whole(3), np.array([0.3, -0.2, 1.0])
    known = replace(known, views=tuple(replace(v, covariance=np.eye(6)) for v in known.views))
    larger, metric = known.resized(2.5, centre), known.in_metres(2.5, centre)
    for before, after in zip(known.views, larger.views, strict=True):
        np.testing.assert_allclose(seen(after.T_world_camera, larger.points), before.pixels)
        np.testing.assert_allclose(after.T_world_camera[:3, 3] - centre, 2.5 * (before.T_world_camera[:3, 3] - centre))
    np.testing.assert_allclose(larger.points - centre, 2.5 * (POINTS - centre))
    np.testing.assert_array_equal(larger.newest.covariance, np.eye(6))
    np.testing.assert_allclose(np.diag(metric.newest.covariance), [6.25] * 3 + [1.0] * 3)
    np.testing.assert_array_equal(metric.points, larger.points)


def test_a_pose_is_that_of_the_corners_that_agree() -> None:
    pixels = seen(pose(3), POINTS) + RNG.normal(0, 0.3, (len(POINTS), 2))
    pixels[::4] += RNG.uniform(20, 60, (15, 2))
    found = solved(POINTS, pixels, K, 3.0, 20)
    T, agree = found
    assert np.flatnonzero(~agree).tolist() == list(range(0, 60, 4))
    fit = refined(POINTS[agree], pixels[agree], T, K, 0.7, 3.0)
    assert fit.count == 45
    assert np.abs(se3.log(invert(pose(3)) @ fit.T_world_camera)).max() < 0.005
    assert solved(POINTS[:19], pixels[:19], K, 3.0, 20) is None
    assert solved(POINTS[::4], pixels[::4], K, 3.0, 10) is None


# -- the scale -------------------------------------------------------------------------------------------------


def referred(units: float) -> list[View]:
    """Keyframes of a map that has so many metres by each unit, beside a reference in a frame of its own."""
    nothing = np.zeros(0, np.int64)
    known = MonoMap(tuple(view(k, nothing) for k in range(3))).resized(1 / units, np.zeros(3))
    start = se3.exp(np.array([5.0, 2.0, 0.0, 0.0, 0.0, 1.0]))
    return [replace(v, T_reference=start @ pose(v.stamp)) for v in known.views]


@pytest.mark.parametrize("units", [0.2, 1.0, 3.0])
def test_ways_between_keyframes_by_those_of_the_reference_are_the_scale(units: float) -> None:
    told = ratio(referred(units))
    assert told[0] == pytest.approx(units)
    assert told[1] == pytest.approx(2 * float(np.linalg.norm(pose(1)[:3, 3])), rel=1e-3)
    factor, scale = Scale().corrected(referred(units), 0.02)
    assert factor == pytest.approx(units)
    assert 0.02 < scale.sigma < 0.04


def test_a_way_that_the_reference_did_not_measure_gives_no_scale() -> None:
    known = referred(2.0)
    apart = [known[0], replace(known[1], T_reference=None), known[2]]
    assert ratio(apart) is None
    still = [replace(v, T_reference=se3.exp(np.array([0.3 * FEWEST_METRES * v.stamp, 0, 0, 0, 0, 0]))) for v in known]
    assert ratio(still) is None
    backwards = [replace(v, T_reference=pose(-v.stamp)) for v in known]
    assert ratio(backwards) is None
    assert Scale().corrected(apart, 0.02) == (1.0, Scale())
    assert Scale(0.05).corrected(apart, 0.02)[1].sigma > 0.05  # the map's own wander


def test_a_known_scale_yields_in_part_and_never_by_much_at_once() -> None:
    equal, _ = Scale(0.1).weighed(1.2, 0.1, 0.0)
    assert equal == pytest.approx(np.sqrt(1.2))
    assert Scale(0.1).weighed(50.0, 1e-6, 0.0)[0] == pytest.approx(1.3, rel=1e-3)
    assert Scale(0.1).weighed(1.0, 0.1, 0.0)[1].sigma == pytest.approx(0.1 / np.sqrt(2))
    assert Scale(0.1).weighed(1.0, 0.1, 0.09)[1].sigma == pytest.approx(0.09)
    assert Scale(0.01).weighed(1.02, 0.02, 0.02)[1].sigma <= 0.01
    assert Scale().weighed(3.0, 0.05, 0.02) == (3.0, Scale(0.05))
