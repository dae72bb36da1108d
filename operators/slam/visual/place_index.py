"""Places that look alike: each feature of a view votes for the views of the map that hold a distinctly near one.

McCann and Lowe, "Local naive Bayes nearest neighbor for image classification", 2012, on rooted SIFT descriptors
(Arandjelović and Zisserman, "Three things everyone should know to improve object retrieval", 2012). Distances count as
they are, not which cell of a vocabulary they fall into, so nothing is trained or loaded. The time grows with the number
of views.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LENGTH = 128  # of a descriptor
KEPT = 256  # descriptors of a view that are looked for
ASKED = 128  # descriptors of a view that look for others
CROWD = 10  # a feature votes for views that are nearer to it than the tenth nearest
UNRELATED = 0.3  # squared distance of unit vectors beyond which descriptors say nothing, however few views there are

Array32 = NDArray[np.float32]


def rooted(descriptors: NDArray[np.uint8], most: int) -> Array32:
    """Returns unit vectors (N, 128) whose products are Bhattacharyya's coefficients; N is `most` or less."""
    chosen = descriptors
    if len(descriptors) > most:
        chosen = descriptors[np.linspace(0, len(descriptors) - 1, most).astype(np.int64)]
    roots = np.sqrt(chosen.astype(np.float32))
    return np.asarray(roots / np.maximum(np.linalg.norm(roots, axis=1, keepdims=True), 1e-6), np.float32)


class PlaceIndex:
    """Views by their descriptors. Keys are given once each."""

    def __init__(self) -> None:
        self.keys: list[int] = []
        self._held = np.zeros((16, KEPT, LENGTH), np.float32)  # of each view; rows of zeros are like nothing

    def __len__(self) -> int:
        return len(self.keys)

    def add(self, key: int, descriptors: NDArray[np.uint8]) -> None:
        """Takes a view's descriptors (N, 128)."""
        place = len(self.keys)
        if place == len(self._held):
            self._held = np.concatenate([self._held, np.zeros_like(self._held)])
        vectors = rooted(descriptors, KEPT)
        self._held[place, : len(vectors)] = vectors
        self.keys.append(key)

    def likeness(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Returns how much each view, in the order of the keys, has in common with the descriptors (N, 128).

        It is the mean over the features of how much nearer the view's nearest one is than that of most other views: 0
        for nothing in common, at most `UNRELATED`.
        """
        count = len(self.keys)
        asked = rooted(descriptors, ASKED)
        if not count or not len(asked):
            return np.zeros(count)
        products = asked @ self._held[:count].reshape(-1, LENGTH).T
        distance = 2.0 - 2.0 * products.reshape(len(asked), count, KEPT).max(axis=2)
        crowd = np.full(len(asked), UNRELATED, np.float32)
        if count > CROWD:
            crowd = np.minimum(crowd, np.partition(distance, CROWD, axis=1)[:, CROWD])
        return np.asarray(np.maximum(crowd[:, None] - distance, 0.0).mean(axis=0), np.float64)
