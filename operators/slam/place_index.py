"""Places that look alike: views as bags of visual words, compared through an inverted index.

Sivic and Zisserman, "Video Google", 2003. A word is a descriptor's side of random planes (Charikar, "Similarity
estimation techniques from rounding algorithms", 2002), so there is no vocabulary to be trained or loaded; each
descriptor has one in every one of several tables, and two that are alike share some of them.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

TABLES = 8
BITS = 11
WORDS = TABLES << BITS
LENGTH = 128  # of a descriptor

Words = NDArray[np.int32]


@cache
def _planes() -> NDArray[np.float32]:
    return np.random.default_rng(20031013).standard_normal((LENGTH, TABLES * BITS)).astype(np.float32)


def words_of(descriptors: NDArray[np.uint8]) -> Words:
    """Returns the different words, ascending, of descriptors (N, 128)."""
    if not len(descriptors):
        return np.zeros(0, np.int32)
    rooted = np.sqrt(descriptors.astype(np.float32))
    rooted /= np.maximum(np.linalg.norm(rooted, axis=1, keepdims=True), 1e-6)
    rooted -= 0.0722  # about the mean of a unit vector's entries: the planes then halve the descriptors
    bits = (rooted @ _planes() > 0).reshape(-1, TABLES, BITS)
    codes = bits @ (1 << np.arange(BITS))
    return np.unique(codes + (np.arange(TABLES) << BITS)).astype(np.int32)


class PlaceIndex:
    """Views by the words in them: for each word, which views have it. Keys are given once each."""

    def __init__(self) -> None:
        self.keys: list[int] = []
        self._lengths: list[int] = []
        self._holders = np.zeros((WORDS, 64), np.uint8)  # (word, view)

    def __len__(self) -> int:
        return len(self.keys)

    def add(self, key: int, words: Words) -> None:
        place = len(self.keys)
        if place == self._holders.shape[1]:
            self._holders = np.concatenate([self._holders, np.zeros_like(self._holders)], axis=1)
        self.keys.append(key)
        self._lengths.append(len(words))
        self._holders[words, place] = 1

    def likeness(self, words: Words) -> NDArray[np.float64]:
        """Returns how much each view, in the order of the keys, has in common with the words.

        It is near 1 for the same words and 0 for none in common; a word counts the more, the fewer views have it.
        """
        count = len(self.keys)
        if not count or not len(words):
            return np.zeros(count)
        held = self._holders[words, :count].astype(np.float32)
        rarity = np.log((count + 1.0) / (held.sum(axis=1) + 0.5)) ** 2
        shared = rarity.astype(np.float32) @ held
        mean = float(rarity.mean())
        return np.asarray(shared / (mean * np.sqrt(len(words) * np.maximum(self._lengths, 1))), np.float64)
