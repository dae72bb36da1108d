"""Places recognised by their words, on made descriptors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from operators.slam.place_index import WORDS, PlaceIndex, words_of


def place(seed: int, count: int = 200) -> np.ndarray:
    """Descriptors as SIFT has them: few large entries, many small ones."""
    return np.clip(np.random.default_rng(seed).exponential(35, (count, 128)), 0, 255).astype(np.uint8)


def seen_again(descriptors: np.ndarray, seed: int, share: float = 0.5, noise: float = 10.0) -> np.ndarray:
    """A share of the descriptors with noise, in another order, among others that are new."""
    rng = np.random.default_rng(seed)
    kept = rng.permutation(len(descriptors))[: int(share * len(descriptors))]
    noisy = np.clip(descriptors[kept] + rng.normal(0, noise, (len(kept), 128)), 0, 255).astype(np.uint8)
    return np.concatenate([place(seed + 10**6, len(descriptors) - len(kept)), noisy])


@given(st.integers(0, 1000), st.integers(0, 60))
def test_words_are_different_ones_in_order_and_of_no_order_of_features(seed: int, count: int) -> None:
    descriptors = place(seed, count)
    words = words_of(descriptors)
    assert (np.diff(words) > 0).all()
    assert len(words) == 0 or (words[0] >= 0 and words[-1] < WORDS)
    assert (words_of(descriptors[::-1]) == words).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_place_seen_again_is_the_likest_of_many(seed: int) -> None:
    places = [place(100 * seed + k) for k in range(80)]
    index = PlaceIndex()
    for k, descriptors in enumerate(places):
        index.add(1000 + k, words_of(descriptors))
    for k in (0, 17, 79):
        likeness = index.likeness(words_of(seen_again(places[k], seed)))
        assert index.keys[int(np.argmax(likeness))] == 1000 + k
        assert likeness.max() > 1.4 * np.sort(likeness)[-2]


def test_the_same_view_is_as_like_as_can_be_and_a_view_of_nothing_is_like_none() -> None:
    index = PlaceIndex()
    assert index.likeness(words_of(place(0))).tolist() == []
    index.add(3, words_of(place(0)))
    index.add(5, words_of(np.zeros((0, 128), np.uint8)))
    assert index.likeness(words_of(place(0)))[0] == pytest.approx(1.0, abs=1e-4)
    assert index.likeness(words_of(place(0)))[1] == 0.0
    assert (index.likeness(words_of(np.zeros((0, 128), np.uint8))) == 0).all()
    assert len(index) == 2
