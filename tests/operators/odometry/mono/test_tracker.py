"""Monocular odometry on images of a made corner of two walls: its path, its unit, and what it says when it is blind."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from made_walls import RATE, SIZE, K, aside, rendered, seen_from
from numpy.typing import NDArray

from operators.evaluation.trajectory import align
from operators.geometry import se3
from operators.odometry.mono.settings import MonoOdometryConfig
from operators.odometry.mono.tracker import MonoOdometry, MonoResult
from operators.odometry.tracking import MEASURED, Status

Gray = NDArray[np.uint8]
Array = NDArray[np.float64]


def follow(
    images: Sequence[Gray], references: Sequence[Array | None] | None = None, config: MonoOdometryConfig | None = None
) -> list[MonoResult]:
    odometry = MonoOdometry(K, config)
    told = references or [None] * len(images)
    return [odometry.track(image, k * 10**9 // RATE, T) for k, (image, T) in enumerate(zip(images, told, strict=True))]


def words(results: Sequence[MonoResult]) -> list[str]:
    return [r.track.status.value for r in results]


def errors(results: Sequence[MonoResult], truth: Sequence[Array], scaled: bool) -> Array:
    """Position errors (N,) in metres of what was measured, after alignment."""
    pairs = [(r.track.T_world_camera, T) for r, T in zip(results, truth, strict=True) if r.track.status in MEASURED]
    a, b = (np.array([T[:3, 3] for T in poses]) for poses in zip(*pairs, strict=True))
    R, t, s = align(a, b, scaled=scaled)
    return np.asarray(np.linalg.norm(s * a @ R.T + t - b, axis=1))


def test_the_path_is_followed_up_to_its_scale() -> None:
    truth = aside(40)
    results = follow(rendered(40))
    said = words(results)
    begun = said.index("tracking")
    assert begun <= 14
    assert set(said[:begun]) == {"initialising"}
    assert set(said[begun:]) == {"tracking"}
    assert errors(results, truth, scaled=True).max() < 0.02
    assert not results[-1].scale.known
    assert 4 <= sum(r.track.keyframe for r in results) <= 8  # one for every tenth of a metre or two, 3 m away


def test_a_reference_in_metres_gives_the_scale() -> None:
    truth = aside(40)
    start = se3.exp(np.array([5.0, 2.0, 0.0, 0.0, 0.0, 1.0]))  # a frame of its own
    results = follow(rendered(40), [start @ T for T in truth])
    assert results[-1].scale.known
    assert errors(results, truth, scaled=False).max() < 0.03
    way = np.linalg.norm(results[-1].track.T_world_camera[:3, 3] - results[20].track.T_world_camera[:3, 3])
    assert way == pytest.approx(float(np.linalg.norm(truth[-1][:3, 3] - truth[20][:3, 3])), rel=0.03)
    speed = results[-1].track.velocity[:3]
    assert np.linalg.norm(speed) == pytest.approx(0.03 * RATE, rel=0.3)


@pytest.mark.long
def test_a_reference_that_comes_later_brings_the_map_to_metres() -> None:
    truth = aside(40)
    results = follow(rendered(40), [None] * 20 + [*truth[20:]])
    assert not results[19].scale.known
    assert results[-1].scale.known
    way = np.linalg.norm(results[-1].track.T_world_camera[:3, 3] - results[-6].track.T_world_camera[:3, 3])
    assert way == pytest.approx(float(np.linalg.norm(truth[-1][:3, 3] - truth[-6][:3, 3])), rel=0.05)
    # The way before is in metres, too: the position counts from where the map began.
    since = float(np.linalg.norm(results[-1].track.T_world_camera[:3, 3]))
    assert since == pytest.approx(float(np.linalg.norm(truth[-1][:3, 3])), rel=0.05)


def test_black_images_are_predicted_then_lost_and_the_map_is_found_again() -> None:
    truth = aside(40)
    images = list(rendered(40))
    black = np.zeros_like(images[0])
    given = [*images[:30], *[black] * 20, *images[29:19:-1]]
    results = follow(given)
    said = words(results)
    assert said[30] == "predicted"
    assert said[49] == "lost"
    assert "black" in results[45].track.reason
    assert "relocalised" in said[50:53]
    assert said[-1] == "tracking"
    found = [*results[:30], *results[53:]]
    assert errors(found, [*truth[:30], *truth[29:19:-1][3:]], scaled=True).max() < 0.03
    grown = [np.trace(r.track.covariance) for r in results[29:50]]
    assert all(b > a for a, b in pairwise(grown))


def test_a_turn_on_the_spot_begins_nothing_and_is_named() -> None:
    turning = [se3.exp(np.array([0, 0, 0, 0, 0.02 * k, 0])) for k in range(12)]
    results = follow([seen_from(T) for T in turning])
    assert set(words(results)) == {"initialising"}
    assert "pure rotation" in results[-1].track.reason


def test_a_blank_wall_is_named() -> None:
    rng = np.random.default_rng(0)
    flat = [np.clip(128 + rng.normal(0, 1, SIZE[::-1]), 0, 255).astype(np.uint8) for _ in range(4)]
    results = follow(flat)
    assert set(words(results)) == {"initialising"}
    assert "contrast" in results[-1].track.reason
    ramp = np.tile(np.linspace(60, 180, SIZE[0]).astype(np.uint8), (SIZE[1], 1))
    shaded = [np.roll(ramp, k, axis=1).copy() for k in range(3)]
    results = follow(shaded)
    assert "too little texture" in results[-1].track.reason


@pytest.mark.long
def test_a_view_of_something_else_is_lost_until_a_new_map_begins() -> None:
    images = list(rendered(30))
    elsewhere = [np.ascontiguousarray(np.rot90(i, 2)) for i in images]  # the same walls upside down
    config = MonoOdometryConfig(patience_s=0.2, give_up_s=0.2)
    results = follow([*images[:20], *elsewhere], config=config)
    said = words(results)
    assert "lost" in said[20:]
    assert said[-1] == "tracking"
    assert any("a new map" in r.track.reason for r in results)
    assert Status.TRACKING not in [r.track.status for r in results[20:23]]


def test_wrong_images_and_stamps_are_refused() -> None:
    odometry = MonoOdometry(K)
    odometry.track(rendered(1)[0], 5)
    with pytest.raises(ValueError, match="does not follow"):
        odometry.track(rendered(1)[0], 5)
    with pytest.raises(ValueError, match="size changed"):
        odometry.track(np.zeros((100, 100), np.uint8), 6)
    with pytest.raises(ValueError, match="uint8"):
        odometry.track(np.zeros((100, 100), np.float64), 6)


# -- the adjustment and the scale ------------------------------------------------------------------------------
