"""A heading that was told comes into question by evidence that chance seldom gives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from operators.fusion.filter.error_state import SIZE, Noise, State
from operators.fusion.filter.history import Hypothesis, Sample
from operators.fusion.filter.hypotheses import doubted
from operators.fusion.filter.initialisation import Prior, first_node

STATE = State(np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), np.eye(SIZE))


@pytest.mark.parametrize(
    ("wrong", "before", "expected"),
    [
        (0.025, False, False),
        (0.04, False, True),
        (0.02, True, True),  # once in question it stays so for a while
        (0.005, True, False),
        (0.9, False, True),
    ],
)
def test_given_heading_is_doubted_with_hysteresis(wrong: float, before: bool, expected: bool) -> None:
    """Two headings against it, one of which alone would not do."""
    weights = [math.log(1 - wrong), *[math.log(wrong / 2)] * 2]
    hypotheses = [Hypothesis(w, STATE, against=k > 0) for k, w in enumerate(weights)]
    assert doubted(hypotheses, before) == expected


def test_alternative_headings_begin_without_doubting_the_given_one() -> None:
    samples = [Sample(k * 10**7, np.zeros(3), np.array([0, 0, 9.81]), Noise(1e-3, 1e-2, 1e-5, 1e-4)) for k in range(50)]
    node = first_node(samples, Prior(heading=0.3, heading_sigma=0.05), 9.81, at_rest=True)
    assert len(node.hypotheses) == 12
    assert not doubted(node.hypotheses, before=True)
    assert not doubted([Hypothesis(0.0, STATE)], before=True)
