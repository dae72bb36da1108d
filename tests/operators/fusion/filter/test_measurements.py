"""The room that a filter makes for a residual."""

from __future__ import annotations

import numpy as np
import pytest

from operators.fusion.filter.error_state import POSITION, ROTATION, VELOCITY
from operators.fusion.filter.measurements import Model, Position, Range

NONE = np.zeros(3)


@pytest.mark.parametrize("model", [Position(NONE, NONE), Range(np.array([5.0]), NONE, NONE)])
@pytest.mark.parametrize(("seconds", "over"), [(2.0, 2.0), (0.01, 0.1)])
def test_residual_of_a_place_may_be_of_the_position_or_of_the_velocity_since(
    model: Model, seconds: float, over: float
) -> None:
    residual = np.array([3.0])
    room = model.widening(residual, seconds)
    assert np.allclose(room[POSITION], 9.0)
    assert np.allclose(room[VELOCITY], 9.0 / over**2)
    assert not room[ROTATION].any()
