"""The first estimate of a body without inertial sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from operators.fusion.filter.error_state import ROTATION
from operators.fusion.filter.initialisation import Prior, coasting_node


@pytest.mark.parametrize(("heading", "sigma"), [(0.7, 0.05), (None, math.pi)])
def test_body_without_inertial_sensor_begins_level_at_its_heading_or_at_any(
    heading: float | None, sigma: float
) -> None:
    node = coasting_node(10**9, Prior(heading=heading, heading_sigma=0.05), 9.81)
    only = max(node.hypotheses, key=lambda h: h.weight)
    assert node.time == 10**9
    assert not only.against
    assert [h.against for h in node.hypotheses].count(False) == 1
    assert np.allclose(only.state.rotation[2], [0, 0, 1])
    assert math.atan2(only.state.rotation[1, 0], only.state.rotation[0, 0]) == pytest.approx(heading or 0.0)
    about_up = only.state.rotation @ only.state.covariance[ROTATION, ROTATION] @ only.state.rotation.T
    assert math.sqrt(about_up[2, 2]) == pytest.approx(sigma, rel=1e-3)
