"""What several looks at a posture tell together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from operators.recognition.activity.recognizer import PostureWindow


def probabilities(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def test_looks_count_for_half_a_second() -> None:
    looks = PostureWindow()
    assert looks.evidence(1.0) is None
    looks.update(1.0, probabilities(0.8, 0.2))
    looks.update(1.5, None)
    assert looks.evidence(1.0) is not None
    looks.update(1.6, None)
    assert looks.evidence(1.0) is None


def test_contradicting_postures_cancel() -> None:
    looks = PostureWindow()
    looks.update(0.0, probabilities(0.9, 0.1))
    looks.update(0.25, probabilities(0.1, 0.9))
    found = looks.evidence(1.0)
    np.testing.assert_allclose(found, 1.0, atol=1e-5)


@given(
    looks=st.lists(st.lists(st.floats(0, 1, width=32), min_size=3, max_size=3), min_size=1, max_size=4),
    weight=st.floats(0, 3),
)
def test_the_likeliest_has_one_and_none_has_nothing(looks: list[list[float]], weight: float) -> None:
    taken = PostureWindow()
    for k, look in enumerate(looks):
        taken.update(0.1 * k, probabilities(*look))
    found = taken.evidence(weight)
    assert found.max() == pytest.approx(1.0)
    assert found.min() >= 0.01**weight * 0.99
    if weight == 0:
        assert (found == 1).all()
