"""What motion and surroundings exclude of what an agent may do."""

from __future__ import annotations

import numpy as np
import pytest

from operators.recognition.agent_features import FAR, NAMES
from operators.recognition.possible import possible

CLASSES = ("walking", "sitting_down", "standing_up")
MOVERS = ("driving", "resting")


def allowed(features: dict[str, float], classes: tuple[str, ...] = CLASSES) -> set[str]:
    """Returns what is possible for an agent with these features; the others are 0."""
    vector = np.zeros((1, len(NAMES)), np.float32)
    for name, value in features.items():
        vector[0, NAMES.index(name)] = value
    return {name for name, is_so in zip(classes, possible(vector, classes)[0].tolist(), strict=True) if is_so}


@pytest.mark.parametrize(
    ("away", "rise", "expected"),
    [
        (0.4, -0.3, {"walking", "sitting_down"}),
        (0.4, 0.3, {"walking", "standing_up"}),
        (0.4, 0.0, {"walking", "sitting_down", "standing_up"}),
        (1.2, -0.3, {"walking"}),  # no seat in reach
        (1.2, 0.3, {"walking"}),
    ],
)
def test_seats_and_the_way_of_the_head_decide_on_sitting_down_and_standing_up(
    away: float, rise: float, expected: set[str]
) -> None:
    assert allowed({"seat: away": away / FAR, "rise, short": rise}) == expected


@pytest.mark.parametrize(("speed", "drives"), [(0.0, False), (0.03, False), (0.2, True)])
def test_what_drives_moves(speed: float, drives: bool) -> None:
    assert ("driving" in allowed({"speed, long": speed}, MOVERS)) == drives


@pytest.mark.parametrize(
    ("kind", "speed", "way", "rests"),
    [
        ("robot", 0.12, 0.3, False),
        ("robot", 0.07, 0.17, True),  # as fast as a resting one is seen to be at times
        ("robot", 0.2, 0.05, True),  # two looks that are a little apart
        ("ball", 0.12, 0.3, True),
    ],
)
def test_a_robot_that_moves_does_not_rest(kind: str, speed: float, way: float, rests: bool) -> None:
    features = {f"is a {kind}": 1.0, "speed, long": speed, "way gone": way}
    assert ("resting" in allowed(features, MOVERS)) == rests


def test_classes_that_a_network_lacks_are_no_error_and_nobody_is_none() -> None:
    assert possible(np.zeros((2, len(NAMES)), np.float32), ("walking",)).all()
    assert possible(np.zeros((0, len(NAMES)), np.float32), CLASSES).shape == (0, len(CLASSES))
