"""What a view says of whether a thing is still where it was."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.labels import SizePrior
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.map_object import MapObject
from operators.scene.map.matching import MapSettings
from operators.scene.map.presence import has_left, look_at
from operators.scene.map.range_view import RangeView
from operators.scene.map.voxels import VoxelSet

S = MapSettings()
BALL, CRATE = 0, 1
PRIORS = ClassPriors([BALL], {})


def facing(x: float, y: float, side: float, count: int) -> NDArray[np.float64]:
    """Points of a square that faces the origin, in a plane across x."""
    across = np.linspace(-side / 2, side / 2, count)
    return np.stack(np.meshgrid([x], across + y, across), axis=-1).reshape(-1, 3)


def thing(x: float, class_id: int = BALL) -> MapObject:
    """Something of 8 cm whose near side is at x, known for long."""
    votes = np.eye(2)[class_id]
    made = MapObject(1, VoxelSet.of(facing(x, 0.0, 0.08, 6), S.voxel), votes, 6.0, 0, 0, views=9)
    made.center, made.size = np.array([x + 0.04, 0.0, 0.0]), np.full(3, 0.08)
    return made


def view(*surfaces: NDArray[np.float64]) -> RangeView:
    return RangeView(np.concatenate(surfaces), np.eye(4), 0.012)


@pytest.mark.parametrize(("behind", "left"), [(0.12, True), (0.03, False)])
def test_ball_has_left_where_a_surface_close_behind_it_is_visible(behind: float, left: bool) -> None:
    """2 m away, where ranges stray by 5 mm, 12 cm are seen; the margin for things of any size is 14 cm."""
    ball, around = thing(2.0), view(facing(2.0 + behind, 0.0, 1.2, 160))
    assert not around.of(ball.voxels.points, S.margin).free.any()
    assert has_left(ball, around, S) == left


def test_a_ball_that_is_still_there_or_hidden_has_not_left() -> None:
    wall, ball = facing(2.3, 0.0, 1.2, 160), thing(2.0)
    assert not has_left(ball, view(facing(2.01, 0.0, 0.08, 30)), S)
    assert not has_left(ball, view(wall, facing(1.2, 0.0, 0.3, 80)), S)
    assert not has_left(ball, view(facing(2.3, 3.0, 0.4, 80)), S)


def test_noise_of_far_ranges_does_not_say_that_a_ball_has_left() -> None:
    """At 6 m they stray by 43 mm."""
    assert not has_left(thing(6.0), view(facing(6.12, 0.0, 1.2, 160)), S)


@pytest.mark.parametrize(("left", "lost"), [(True, S.vacated), (False, S.missed)])
def test_an_empty_place_takes_more_evidence_than_a_thing_that_was_not_detected(left: bool, lost: float) -> None:
    ball, around = thing(2.0), view(facing(2.05, 0.0, 1.2, 160))
    sight = around.of(ball.voxels.points, S.margin)
    look_at(ball, sight, around.origin, None, 0.25, PRIORS, S, left=left)
    assert ball.evidence == pytest.approx(6.0 - lost)


def test_only_small_things_of_classes_that_move_or_are_taken_may_leave() -> None:
    ball, crate = thing(2.0), thing(2.0, CRATE)
    assert PRIORS.may_leave(ball)
    assert not PRIORS.may_leave(crate)
    assert ClassPriors([], {}, (), [CRATE]).may_leave(crate)
    ball.size = np.full(3, 0.8)
    assert not PRIORS.may_leave(ball)


def test_an_object_is_doubted_whose_size_is_four_spreads_above_every_usual_one() -> None:
    usual = (SizePrior((0.1, 0.2, 0.3), (0.1, 0.2, 0.3)), SizePrior((0.3, 0.4, 0.1), (0.1, 0.1, 0.1)))
    priors, crate, rng = ClassPriors([BALL], {CRATE: usual, BALL: usual}), thing(1.0, CRATE), np.random.default_rng(0)
    fits = []
    for _ in range(300):
        crate.size = np.exp(rng.uniform(-3, 0.5, 3))
        logs = np.log([*np.sort(crate.size[:2]), crate.size[2]])
        fits.append(priors.has_usual_size(crate))
        assert fits[-1] == any((logs - np.log(u.size) <= 4 * np.array(u.spread)).all() for u in usual)
        assert priors.doubt(crate, 0.35) == (0.0 if fits[-1] else 0.5)
    assert 0 < sum(fits) < len(fits)
    ball = thing(1.0, BALL)
    ball.size = np.full(3, 9.0)
    assert priors.has_usual_size(ball)  # the motion of a mover says what it is
