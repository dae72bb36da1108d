"""The odometry's noise is learnt from innovations where they show it, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from operators.slam.landmarks.consistency import Consistency


def learnt(motion: float, scale: float, extra: float = 0.0) -> list[float]:
    """Returns the variance after each of 400 messages of 5 landmarks.

    `motion`: the odometry's part of their freedom of 10;
    `scale`: true variance of the odometry over what was told; `extra`: what else is in the squared innovations.
    """
    rng, made, found = np.random.default_rng(0), Consistency(), []
    for _ in range(400):
        true = scale / made.odometry_variance
        made.update(float(rng.chisquare(10)) + motion * (true - 1) + extra, 10, motion)
        found.append(made.odometry_variance)
    return found


def test_sighting_noise_is_not_attributed_to_the_odometry() -> None:
    assert max(learnt(motion=0.01, scale=1.0, extra=3.0)) == 1.0


def test_noise_of_an_odometry_that_innovations_show_is_learnt() -> None:
    assert learnt(motion=2.0, scale=4.0)[-1] == pytest.approx(4.0, rel=0.3)
