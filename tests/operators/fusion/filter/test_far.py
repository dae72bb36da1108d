"""Room for a place far from the estimate is bounded."""

from __future__ import annotations

import numpy as np
import pytest

from operators.fusion.filter.error_state import POSITION, VELOCITY
from operators.fusion.filter.error_state_filter import FARTHEST, bounded


@pytest.mark.parametrize(("metres", "kept", "far"), [(900.0, 900.0, False), (5000.0, FARTHEST, True)])
def test_room_for_a_place_is_bounded_and_other_rows_are_not(metres: float, kept: float, far: bool) -> None:
    H = np.zeros((4, 15))
    H[:3, POSITION], H[3, VELOCITY] = np.eye(3), [1.0, 0.0, 0.0]
    residual = np.array([0.6 * metres, 0.0, 0.8 * metres, 2000.0])
    shortened, beyond = bounded(residual, H)
    assert np.allclose(shortened, [0.6 * kept, 0.0, 0.8 * kept, 2000.0])
    assert beyond is far
