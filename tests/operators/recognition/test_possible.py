"""What motion and surroundings exclude of what an agent may do."""

from __future__ import annotations

import numpy as np
import pytest

from operators.recognition.agent_features import FAR, NAMES
from operators.recognition.possible import possible

CLASSES = ("walking", "sitting_down", "standing_up", "driving")


def allowed(features: dict[str, float]) -> set[str]:
    """Returns what is possible for an agent with these features; the others are 0."""
    vector = np.zeros((1, len(NAMES)), np.float32)
    for name, value in features.items():
        vector[0, NAMES.index(name)] = value
    return {name for name, is_so in zip(CLASSES, possible(vector, CLASSES)[0].tolist(), strict=True) if is_so}


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
    assert ("driving" in allowed({"speed, long": speed})) == drives


def test_classes_that_a_network_lacks_are_no_error_and_nobody_is_none() -> None:
    assert possible(np.zeros((2, len(NAMES)), np.float32), ("walking",)).all()
    assert possible(np.zeros((0, len(NAMES)), np.float32), CLASSES).shape == (0, 4)
