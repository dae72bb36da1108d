"""What usual sizes keep of a view, wherever the camera stands, and what has an unusual size."""

from __future__ import annotations

import numpy as np
import pytest

from operators.labels import SizePrior
from operators.scene.map.class_priors import ClassPriors

CHAIR = 0
SIZES = SizePrior((0.5, 0.5, 0.9), (0.1, 0.1, 0.1))
PRIORS = ClassPriors([], {CHAIR: (SIZES,)})
EYE = np.array([2.0, -1.0, 1.5])


def seen(heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on a chair 2 m ahead of the camera, and fewer on a wall 4 m ahead of it."""
    random = np.random.default_rng(1)
    chair = random.uniform((1.8, -0.2, 0.0), (2.2, 0.2, 0.9), (200, 3))
    wall = random.uniform((4.0, -0.5, 0.0), (4.1, 0.5, 0.9), (80, 3))
    turn = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    there = [points @ turn.T + [EYE[0], EYE[1], 0] for points in (chair, wall)]
    return there[0], there[1]


@pytest.mark.parametrize("heading", [0.0, 0.7, np.pi / 2, 3.0, -2.0])
def test_a_wall_behind_a_thing_is_left_out_whatever_the_direction_of_view(heading: float) -> None:
    chair, wall = seen(heading)

    kept = PRIORS.near_side(np.vstack([wall, chair]), CHAIR, EYE, noise=0.0)

    np.testing.assert_allclose(kept, chair)


def test_points_of_a_class_without_a_usual_size_stay() -> None:
    points = np.vstack(seen(0.0))

    assert PRIORS.near_side(points, CHAIR + 1, EYE, noise=0.0) is points
