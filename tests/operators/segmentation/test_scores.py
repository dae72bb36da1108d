"""Classes of scores in 8 bits are those of the scores enlarged, and their probability that of a softmax."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from operators.segmentation.scores import best_classes, probability


def enlarged(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, 2H, 2W) of (C, H, W), pixel by pixel."""
    _, height, width = cells.shape
    y, x = np.mgrid[: 2 * height, : 2 * width]
    low, left = y // 2, x // 2
    high, right = np.minimum(low + y % 2, height - 1), np.minimum(left + x % 2, width - 1)
    around = cells[:, low, left] + cells[:, low, right] + cells[:, high, left] + cells[:, high, right]
    return np.asarray(around / 4)


@given(
    seed=st.integers(0, 10_000),
    shape=st.tuples(st.integers(1, 32), st.integers(1, 6), st.integers(1, 6)),
    most=st.sampled_from([1, 3, 255]),
)
def test_best_class_is_the_first_maximum_of_the_enlarged_scores(
    seed: int, shape: tuple[int, int, int], most: int
) -> None:
    scores = np.random.default_rng(seed).integers(0, most, shape, np.uint8, endpoint=True)
    found = best_classes(scores)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, enlarged(scores.astype(np.float64)).argmax(axis=0))


def test_the_probability_is_that_of_the_softmax_enlarged_after() -> None:
    scores = np.random.default_rng(1).integers(0, 255, (18, 5, 7), np.uint8)
    power = np.exp(0.2 * (scores.astype(np.float64) - 255))
    best = (power / power.sum(axis=0)).max(axis=0)
    np.testing.assert_allclose(probability(scores, 0.2), enlarged(best[None])[0], rtol=1e-5)


def test_more_classes_than_a_key_holds_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 32 classes, got 33"):
        best_classes(np.zeros((33, 2, 2), np.uint8))
