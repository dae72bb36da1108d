"""Motion of an agent that is new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operators.recognition.activity.features import NAMES, AgentWindow, Surroundings
from operators.scene.bodies import Body


def person(x: float) -> Body:
    roles = frozenset(("agent", "person"))
    return Body(1, "person", np.array([x, 0.0, 0.85]), np.array([0.5, 0.4, 1.7]), 0.0, np.zeros(3), roles)


@pytest.mark.parametrize(("roles", "speed"), [({"agent"}, 0.0), ({"agent"}, 0.9), ({"agent", "person"}, 0.9)])
def test_speed_of_a_new_robot_is_its_velocity(roles: set[str], speed: float) -> None:
    window, around = AgentWindow(), Surroundings()
    body = replace(person(2.0), roles=frozenset(roles), velocity=np.array([0.0, speed, 0.3]))
    window.add(4.0, body)
    around.update(4.0, [body])
    values = window.vector(body, 0.0, around, None)
    expected = 0.0 if "person" in roles else speed
    assert values[NAMES.index("speed, short")] == pytest.approx(expected)
    assert values[NAMES.index("speed, long")] == pytest.approx(expected)
    assert values[NAMES.index("rise, short")] == 0  # a middle that rises is a foot that comes out of hiding, too
