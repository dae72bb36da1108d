"""Groups of places within reach of each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from operators.scene.lifting import _DENSE, _linked

REACH = 0.1


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 100, _DENSE, _DENSE + 1])
def test_places_linked_directly_or_by_others_are_one_group(count: int) -> None:
    places = np.random.default_rng(count).uniform(0, 0.5, (count, 3))
    near = np.linalg.norm(places[:, None] - places[None], axis=2) <= REACH
    _, expected = connected_components(near, directed=False)
    groups = _linked(places, REACH)
    assert (np.unique(groups, return_inverse=True)[1] == expected).all()  # numbered in the order of their first places


def test_a_chain_is_one_group_whatever_its_order() -> None:
    places = np.stack([np.arange(50) * 0.09, np.zeros(50), np.zeros(50)], axis=1)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(50)
        assert (_linked(places[order], REACH) == 0).all()
