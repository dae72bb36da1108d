"""The vertical of a camera's view, and the height above the ground."""

from __future__ import annotations

import numpy as np
import pytest
from made_view import HEIGHT, room, turned

from operators.cloud.vertical import accelerated, find_vertical, held


@pytest.mark.parametrize(("down", "roll"), [(0, 0), (28, 0), (28, 12), (50, -8), (-15, 3)])
def test_vertical_and_height_of_a_camera_that_is_held_askew(down: float, roll: float) -> None:
    found = find_vertical(room(down, roll).astype(np.float32), *held())
    up = turned(down, roll) @ [0, -1, 0]
    angle = float(np.arccos(min(1.0, found.up @ up)))
    assert np.degrees(angle) < 1
    assert angle < 3 * found.sigma < np.radians(6)
    assert found.rival < 0.1  # so that it decides
    assert found.height == pytest.approx(HEIGHT, abs=0.03)


@pytest.mark.parametrize("step", [1, 40])
@pytest.mark.parametrize(("down", "roll"), [(0, 0), (28, 5), (10, 3), (45, 0)])
def test_walls_alone_are_not_taken_for_a_floor(down: float, roll: float, step: int) -> None:
    found = find_vertical(room(down, roll, floor=False)[::step].astype(np.float32), *held())
    assert float(found.up @ turned(down, roll) @ [0, -1, 0]) > np.cos(np.radians(1))
    assert found.height is None


def test_a_single_wall_leaves_doubt() -> None:
    for wall in np.split(room(28, 5, floor=False), 2):
        found = find_vertical(wall.astype(np.float32), *held())
        assert found.doubt > 1


def test_walls_alone_leave_doubt_that_an_accelerometer_ends() -> None:
    points = room(20, 0, floor=False).astype(np.float32)
    up = turned(20, 0) @ [0, -1, 0]
    alone, helped = find_vertical(points, *held()), find_vertical(points, *accelerated(9.7 * up))
    assert helped.rival < 1e-6 < alone.rival
    assert float(helped.up @ up) > np.cos(np.radians(1.5))
    assert helped.height is None


def test_too_few_points_have_no_vertical() -> None:
    assert find_vertical(room(0, 0)[:30].astype(np.float32), *held()) is None
