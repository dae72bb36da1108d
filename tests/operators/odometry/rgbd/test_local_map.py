"""The keyframes that an odometry remembers: how much memory they take, and which a view is laid on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operators.geometry import se3
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import DRIFTED, RECENT, LocalMap
from operators.odometry.rgbd.surface import Surface
from operators.odometry.rgbd.trial import Trial

K = np.array([[140.0, 0.0, 79.5], [0.0, 140.0, 59.5], [0.0, 0.0, 1.0]])


def keyframe(number: int) -> Keyframe:
    """A view of a wall 2 m away, a step further along it each time."""
    T = np.eye(4)
    T[0, 3] = 0.2 * number
    depth = np.full((120, 160), 2.0, np.float32) + np.linspace(0.0, 0.1, 160, dtype=np.float32)
    none = np.zeros(0)
    return Keyframe(
        stamp=number,
        T_world_camera=T,
        covariance=np.zeros((6, 6)),
        gray=np.zeros((120, 160), np.uint8),
        surface=Surface.from_depth(depth, K, 0.1, 10.0, 1),
        pixels=none.reshape(0, 2),
        points=none.reshape(0, 3),
        ages=none.astype(np.int64),
    )


def held(surface: Surface) -> int:
    """Bytes that a surface keeps, what it has made of its grid included."""
    values = [each for value in vars(surface).values() for each in (value if isinstance(value, tuple) else (value,))]
    return sum(value.nbytes for value in values if isinstance(value, np.ndarray))


def test_only_the_newest_keyframes_keep_what_frames_are_compared_with() -> None:
    known, capacity = LocalMap(20), 20
    grid = held(keyframe(0).surface)
    for number in range(2 * capacity):
        known.add(keyframe(number))
        for reference in known.references(known.newest.T_world_camera, 4, 0):
            assert len(reference.surface.bordered_planes) == reference.surface.bordered.size
    whole = held(known.newest.surface)

    assert len(known.keyframes) == capacity
    assert whole > 5 * grid
    assert sum(held(k.surface) for k in known.keyframes) < capacity * 1.1 * grid + (RECENT + 4) * whole


def test_recomputed_planes_are_identical() -> None:
    surface = keyframe(0).surface
    planes, bordered = surface.bordered_planes, surface.bordered

    surface.let_go()

    assert surface.bordered_planes is not planes
    assert surface.bordered_planes.tobytes() == planes.tobytes()
    assert surface.bordered.tobytes() == bordered.tobytes()


def test_keyframes_with_large_possible_drift_are_not_used() -> None:
    """It comes round to the first of them, whose place by the newest is as unsure as the way between them was long."""
    known = LocalMap(20)
    for number in range(4):
        drifted = number * 0.4 * DRIFTED  # a standard deviation
        known.add(replace(keyframe(number), covariance=np.diag([drifted**2, 0, 0, 0, 0, 0])))

    sure = [k.stamp for k in known.nearby(keyframe(0).T_world_camera, 4, 0, reach=3.0)]

    assert sure == [3, 2]


def test_relocalized_camera_does_not_use_keyframes_passed_while_drifting() -> None:
    known = LocalMap(20)
    known.add(replace(keyframe(1), covariance=np.diag([4 * DRIFTED**2, 0, 0, 0, 0, 0])))
    known.add(keyframe(0))

    assert [k.stamp for k in known.nearby(keyframe(0).T_world_camera, 4, 0)] == [0]


def test_keyframes_beyond_the_drift_do_not_detect_movers() -> None:
    """Laid on one that is off, what stands still would seem to stand before it."""
    known = LocalMap(20)
    known.add(replace(keyframe(0), covariance=np.diag([4 * DRIFTED**2, 0, 0, 0, 0, 0])))
    for number in range(1, 4):
        known.add(keyframe(number))

    assert [k.stamp for k in known.earlier(keyframe(0).T_world_camera, 0)] == [1]


def of_segments(*segments: int) -> LocalMap:
    known = LocalMap(20)
    for number, segment in enumerate(segments):
        known.add(replace(keyframe(number), segment=segment))
    return known


def test_a_new_segment_has_a_number_that_no_other_has() -> None:
    """The third part was joined to the first; the place of the second is still unknown."""
    known = of_segments(0, 1, 2)
    known.join(known.keyframes[0], np.eye(4))
    assert [k.segment for k in known.keyframes] == [0, 1, 0]
    trial = Trial.of(2, 2, np.eye(4), np.zeros((6, 6)), np.eye(4))
    known.part([trial], known.unused_segment)
    assert [k.segment for k in known.keyframes] == [0, 1, 2]


def test_a_camera_found_elsewhere_goes_on_in_the_segment_that_it_was_found_in() -> None:
    known = of_segments(0, 1, 2)
    known.drop_newest_segment(known.keyframes[0])
    assert [k.segment for k in known.keyframes] == [1, 0]


def test_a_segment_whose_place_is_found_is_moved_there_as_a_whole() -> None:
    """Its three keyframes are a step apart in the world of the loss; where the first of them is, is known now."""
    known, T_there = of_segments(0, 0, 1, 1, 1), se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.3]))
    unsure, sunk = 1e-4 * np.eye(6), np.arange(6.0)
    placed = replace(known.keyframes[1], covariance=unsure, sunk=sunk)

    known.join(placed, T_there)

    assert [k.segment for k in known.keyframes] == [0] * 5
    np.testing.assert_array_equal(known.keyframes[1].T_world_camera, keyframe(1).T_world_camera)
    for k in known.keyframes[2:]:
        np.testing.assert_allclose(k.T_world_camera, T_there @ keyframe(k.stamp).T_world_camera, atol=1e-12)
        np.testing.assert_array_equal(k.covariance, unsure)
        np.testing.assert_array_equal(k.sunk, sunk)


def test_keyframes_that_rest_on_a_wrong_place_go_back_and_those_before_it_stay() -> None:
    known, T_wrong = of_segments(1, 0, 0, 0), se3.exp(np.array([2.0, 0.0, -1.0, 0.0, 0.5, 0.0]))
    truth = [k.T_world_camera for k in known.keyframes]
    known.keyframes[2:] = [replace(k, T_world_camera=T_wrong @ k.T_world_camera) for k in known.keyframes[2:]]
    trial = Trial.of(2, 2, truth[2], 1e-2 * np.eye(6), T_wrong @ truth[2])

    known.part([trial], known.unused_segment)

    assert [k.segment for k in known.keyframes] == [1, 0, 2, 2]
    for k, T in zip(known.keyframes, truth, strict=True):
        np.testing.assert_allclose(k.T_world_camera, T, atol=1e-12)
    assert [float(k.place_variance) for k in known.keyframes[:3]] == [0.0, 0.0, pytest.approx(3e-2)]


def test_nearby_keyframes_are_the_newest_then_those_of_largest_overlap() -> None:
    """Of a wall 2 m away, at steps of 0.2 m; what is more than 1.4 m aside shares too little."""
    known, view = of_segments(*[0] * 14, 1), np.eye(4)
    view[0, 3] = 0.63
    assert [k.stamp for k in known.nearby(view, 4, 0)] == [13, 3, 4, 2]
    assert [k.stamp for k in known.nearby(view, 1, 0)] == [13]
    assert sorted(k.stamp for k in known.nearby(view, 20, 0)) == [*range(11), 13]
    assert [k.stamp for k in known.nearby(view, 4, 1)] == [14]


def test_surfaces_are_compared_with_keyframes_that_have_one() -> None:
    known, nothing = of_segments(*[0] * 6), Surface(np.zeros((120, 160), np.float32), K)
    known.keyframes[5] = replace(known.keyframes[5], surface=nothing)
    assert [k.stamp for k in known.references(keyframe(5).T_world_camera, 2, 0)] == [4, 3]


def test_movers_are_detected_by_the_oldest_recent_keyframe_that_shares_the_view() -> None:
    known = of_segments(*[0] * 10)
    assert [k.stamp for k in known.earlier(keyframe(9).T_world_camera, 0)] == [6]
    assert [k.stamp for k in known.earlier(keyframe(6).T_world_camera, 0)] == [4]
    assert known.earlier(keyframe(60).T_world_camera, 0) == []


def test_full_map_drops_redundant_keyframes_and_keeps_the_newest() -> None:
    known = LocalMap(8)
    for number in (0, 4, 8, 12, 13, 14, 15, 16, 17, 18):
        known.add(keyframe(number))
    assert [k.stamp for k in known.keyframes] == [0, 4, 8, 14, 15, 16, 17, 18]


def test_the_map_expects_the_wall_where_a_camera_would_see_it() -> None:
    """From 0.5 m nearer and 0.1 m aside, though no keyframe was there; it is 2 m away, or a little more."""
    known, T = of_segments(0, 0, 0), np.eye(4)
    T[:3, 3] = 0.1, 0.0, 0.5
    seen = known.rendered(T, keyframe(0).surface)
    assert seen.coverage > 0.85
    depth = seen.depth[seen.inverse_depth > 0]
    assert depth.min() > 1.5 - 1e-3
    assert depth.max() < 1.6 + 1e-3
    far = np.eye(4)
    far[2, 3] = 5.0  # behind the wall
    assert known.rendered(far, keyframe(0).surface).coverage == 0.0
