"""Places recognised by their features, on made descriptors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.slam.visual.place_index import ASKED, CROWD, KEPT, UNRELATED, PlaceIndex, rooted


def place(seed: int, count: int = 200) -> np.ndarray:
    """Descriptors as SIFT has them: few large entries, many small ones."""
    return np.clip(np.random.default_rng(seed).exponential(35, (count, 128)), 0, 255).astype(np.uint8)


def seen_again(descriptors: np.ndarray, seed: int, share: float = 0.5, noise: float = 10.0) -> np.ndarray:
    """A share of the descriptors with noise, in another order, among others that are new."""
    rng = np.random.default_rng(seed)
    kept = rng.permutation(len(descriptors))[: int(share * len(descriptors))]
    noisy = np.clip(descriptors[kept] + rng.normal(0, noise, (len(kept), 128)), 0, 255).astype(np.uint8)
    mixed = np.concatenate([place(seed + 10**6, len(descriptors) - len(kept)), noisy])
    return np.asarray(rng.permutation(mixed))


def of(places: list[np.ndarray]) -> PlaceIndex:
    index = PlaceIndex()
    for k, descriptors in enumerate(places):
        index.add(1000 + k, descriptors)
    return index


@pytest.mark.parametrize("count", [2, CROWD, 80])  # fewer than a crowd, as many, many
@pytest.mark.parametrize("seed", range(3))
def test_the_place_seen_again_is_the_likest_of_many(seed: int, count: int) -> None:
    places = [place(100 * seed + k) for k in range(count)]
    index = of(places)
    for k in {0, count // 5, count - 1}:
        likeness = index.likeness(seen_again(places[k], seed))
        assert index.keys[int(np.argmax(likeness))] == 1000 + k
        assert likeness.max() > 3 * np.sort(likeness)[-2]


def test_place_is_recognised_by_few_features_among_common_ones() -> None:
    common = place(999, 80)
    places = [np.concatenate([place(k, 120), common]) for k in range(40)]
    seen = np.concatenate([seen_again(places[7][:120], 1, share=0.21), common])
    assert int(np.argmax(of(places).likeness(seen))) == 7


def test_the_same_view_is_as_like_as_can_be_and_a_view_of_nothing_is_like_none() -> None:
    nothing = np.zeros((0, 128), np.uint8)
    assert PlaceIndex().likeness(place(0)).tolist() == []
    index = of([place(0), nothing])
    assert index.likeness(place(0))[0] == pytest.approx(UNRELATED, abs=1e-4)
    assert index.likeness(place(0))[1] == 0.0
    assert (index.likeness(nothing) == 0).all()
    assert len(index) == 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(0, 2 * KEPT))
def test_likeness_lies_between_nothing_and_the_most_whatever_the_number_of_features(seed: int, count: int) -> None:
    likeness = of([place(seed, count), place(seed + 1)]).likeness(place(seed, count))
    assert ((likeness >= 0) & (likeness <= UNRELATED + 1e-5)).all()
    assert count == 0 or likeness[0] >= likeness[1]


def test_descriptors_become_unit_vectors_and_no_more_than_are_asked_for() -> None:
    vectors = rooted(place(3, 500), ASKED)
    assert vectors.shape == (ASKED, 128)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    assert (rooted(place(3, 500), ASKED) == vectors).all()
