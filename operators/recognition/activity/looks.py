"""The last looks at one person's posture, and what they tell together of what it does."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered

F32 = NDArray[np.float32]

_SPAN = 0.5  # seconds
_DOUBT = 0.01  # what a look leaves to an activity at least


class Looks(Remembered):
    """Looks at a posture in the last half second; each gives probabilities of activities."""

    _taken: deque[tuple[float, F32]]

    def __init__(self) -> None:
        self._taken = deque()

    def update(self, time: float, probabilities: F32 | None) -> None:
        """Takes the look (C,) of a time, seconds, if there is one, and forgets the old ones."""
        if probabilities is not None:
            self._taken.append((time, np.asarray(probabilities, np.float32)))
        while self._taken and self._taken[0][0] < time - _SPAN:
            self._taken.popleft()

    def evidence(self, weight: float) -> F32 | None:
        """Returns factors (C,) for the probabilities of the activities, 1 for the likeliest; None without a look.

        They are the geometric mean over the looks, which are too alike to count as independent ones, to the power
        `weight`. Method: Hinton, "Training products of experts by minimizing contrastive divergence", 2002.
        """
        if not self._taken:
            return None
        logs = np.log(np.maximum(np.stack([look for _, look in self._taken]), _DOUBT)).mean(axis=0)
        return np.asarray(np.exp(weight * (logs - logs.max())), np.float32)
