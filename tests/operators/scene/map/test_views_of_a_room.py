"""The heading of a room, and what a view may show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from operators.scene.map.heading import RoomHeading
from operators.scene.map.range_view import RangeView

RNG = np.random.default_rng(5)


def room(yaw: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Points of two walls and a floor, turned by a heading, with noise of 2 cm."""
    u, v = RNG.uniform(0, 4, 800), RNG.uniform(0, 2.5, 800)
    walls = np.concatenate([np.stack([u, 0 * u, v], axis=1), np.stack([0 * u + 3, u, v], axis=1)])
    floor = np.column_stack([RNG.uniform(0, 4, (800, 2)), np.zeros(800)])
    points = np.concatenate([walls, floor]) + RNG.normal(0, 0.02, (2400, 3))
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]))


@pytest.mark.parametrize(("degrees", "table"), [(0, False), (13, False), (44, False), (88, False), (0, True)])
def test_the_heading_of_a_room_is_that_of_its_walls_and_not_of_a_table_askew(degrees: float, table: bool) -> None:
    """The table's top is seen from near: ten times as many points as the walls have."""
    u, v, c = RNG.uniform(-0.8, 0.8, 16_000), RNG.uniform(-0.4, 0.4, 16_000), np.sqrt(0.5)
    top = np.column_stack([2 + c * (u - v), 2 + c * (u + v), 0.75 + RNG.normal(0, 0.01, 16_000)])
    heading = RoomHeading()
    heading.add(np.concatenate([room(np.radians(degrees)), top[: len(top) * table]]))
    assert heading.angle is not None
    assert abs(np.remainder(np.degrees(heading.angle) - degrees + 45, 90) - 45) < 1.5


def test_a_round_room_and_a_view_of_nothing_upright_have_no_heading() -> None:
    around, up = RNG.uniform(0, 2 * np.pi, 8000), RNG.uniform(0, 2.5, 8000)
    floor = np.column_stack([RNG.uniform(0, 4, (3000, 2)), np.zeros(3000)])
    walls = np.column_stack([3 * np.cos(around), 3 * np.sin(around), up])
    for points, views in ((walls, 1), (np.zeros((0, 3)), 0), (floor, 0)):
        heading = RoomHeading()
        heading.add(points)
        assert (heading.views, heading.angle) == (views, None)


@given(st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-4, 4)), st.floats(0.05, 1.0))
def test_observed_places_are_never_ruled_out(center: tuple[float, float, float], radius: float) -> None:
    """Places in a sphere of which the view knows something, though the sphere is said not to be shown."""
    rays = np.column_stack([RNG.uniform(-0.5, 0.5, 2000), RNG.uniform(-0.4, 0.4, 2000), np.ones(2000)])
    view = RangeView(rays * 3.0, np.eye(4), 0.012)
    offsets = RNG.normal(0, 1, (200, 3))
    places = np.array(center) + radius * offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    sight = view.of(places, 0.1)
    shown = bool(view.may_show(np.array([center]), np.array([radius + 0.1]))[0])
    assert shown or not (sight.free | sight.confirmed).any()
