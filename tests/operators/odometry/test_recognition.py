"""Which descriptors of one view are taken for those of another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.odometry.recognition import Description, describe, match, match_of_size

Bytes = NDArray[np.uint8]


def drawn(count: int, seed: int = 0) -> Bytes:
    """Descriptors (N, 128), no two of them alike."""
    return np.random.default_rng(seed).integers(0, 255, (count, 128)).astype(np.uint8)


def near(descriptors: Bytes, by: int) -> Bytes:
    """The descriptors a little later: each byte is off by no more than so much."""
    noise = np.random.default_rng(by).integers(-by, by + 1, descriptors.shape)
    return np.clip(descriptors.astype(int) + noise, 0, 255).astype(np.uint8)


def described(descriptors: Bytes) -> Description:
    return Description(np.zeros((len(descriptors), 2)), descriptors)


def pairs_of(a: Bytes, b: Bytes, size_a: NDArray[np.float64] | None = None, most: int = 99) -> list[list[int]]:
    sizes = np.ones(len(a)) if size_a is None else size_a
    return match_of_size(a, b, sizes, np.ones(len(b)), most).tolist()


def test_descriptors_pair_with_those_that_they_were() -> None:
    known, order = drawn(6), [3, 0, 5, 1]
    seen = near(known[order], 3)
    assert match(described(known), described(seen)).tolist() == [[3, 0], [0, 1], [5, 2], [1, 3]]
    assert sorted(pairs_of(known, seen)) == [[0, 1], [1, 3], [3, 0], [5, 2]]


def test_ambiguous_descriptors_are_unmatched_and_matches_are_unique() -> None:
    known = drawn(4)
    later, twice = near(known, 9), np.concatenate([known, near(known[:1], 2)])
    assert match(described(later), described(twice)).tolist() == [[1, 1], [2, 2], [3, 3]]
    assert sorted(pairs_of(later, twice)) == [[1, 1], [2, 2], [3, 3]]
    again = np.concatenate([near(known, 6), known])  # two that are nearest to the same one: the nearer is paired
    assert match(described(again), described(known)).tolist() == [[4, 0], [5, 1], [6, 2], [7, 3]]
    assert sorted(pairs_of(again, known)) == [[4, 0], [5, 1], [6, 2], [7, 3]]


def test_keypoints_of_another_size_are_neither_rivals_nor_pairs() -> None:
    known = drawn(4)
    twice = np.concatenate([known, near(known, 2)])
    sizes = np.array([1.0, 1.5, 0.5, 2.0] + [9.0] * 4)
    assert sorted(match_of_size(twice, known, sizes, np.ones(4), 99).tolist()) == [[0, 0], [1, 1]]


def test_the_nearest_pairs_come_first_and_no_more_than_asked_for() -> None:
    known = drawn(5)
    seen = np.concatenate([near(known[k : k + 1], by) for k, by in enumerate((9, 1, 30, 4, 16))])
    assert [a for a, _ in pairs_of(known, seen)] == [1, 3, 0, 4, 2]
    assert [a for a, _ in pairs_of(known, seen, most=2)] == [1, 3]


@pytest.mark.parametrize(("here", "there"), [(0, 5), (1, 5), (5, 1), (5, 0)])
def test_a_descriptor_without_a_second_to_compare_with_is_not_distinct(here: int, there: int) -> None:
    a, b = drawn(here), drawn(there)
    assert match(described(a), described(b)).shape == (0, 2)
    assert match_of_size(a, b, np.ones(here), np.ones(there), 9).shape == (0, 2)


def test_a_bare_view_has_no_descriptors() -> None:
    bare = describe(np.full((120, 160), 90, np.uint8))
    assert (bare.pixels.shape, bare.descriptors.shape, bare.sizes.shape) == ((0, 2), (0, 128), (0,))
