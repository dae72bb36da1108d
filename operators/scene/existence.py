"""Existence of the entries of a map, by the answers that a detector gives to what is there and to what is not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LOOK = 0.7
"""Seconds of views that tell as much as one independent view does: images soon after each other err alike."""

_BINS = 20  # of scores
_THIRDS = (1 / 3, 2 / 3)  # quantiles of a detector's own scores that divide weak, middling and strong ones
_REAL = np.array([0.15, 0.10, 0.25, 0.25, 0.25])  # answers to a real thing before anything is learned:
_FALSE = np.array([0.45, 0.25, 0.15, 0.10, 0.05])  # none, another class, weak, middling, strong
_PRIOR = 4.0  # independent views that this is worth
_SHARE, _SHARE_PRIOR = 0.5, 5.0  # of entries that are real before anything is learned, and the entries it is worth
_ROUNDS = 20


@dataclass
class Answers:
    """A detector's answers at one place: seconds of plain views without any (`missed`), and by class and score."""

    missed: float = 0.0
    given: dict[int, Array] = field(default_factory=dict)

    def add(self, class_id: int, score: float, seconds: float) -> None:
        """Counts a detection of a class."""
        row = self.given.setdefault(class_id, np.zeros(_BINS))
        row[min(int(score * _BINS), _BINS - 1)] += min(seconds, LOOK)

    def miss(self, seconds: float) -> None:
        """Counts a view that shows the place plainly without a detection."""
        self.missed += min(seconds, LOOK)

    def take(self, other: Answers) -> None:
        """Takes those of an entry that is of the same thing."""
        for class_id, row in other.given.items():
            self.given[class_id] = self.given.get(class_id, 0.0) + row
        self.missed = min(self.missed, other.missed)  # while the one was seen, the other was missed

    def counts(self, class_id: int, edges: tuple[int, int]) -> Array:
        """Returns the answers (5,) to a thing of a class: none, another class, and its own, divided by score."""
        own = self.given.get(class_id, np.zeros(_BINS))
        others = sum(float(row.sum()) for k, row in self.given.items() if k != class_id)
        low, high = edges
        parts = own[:low].sum(), own[low:high].sum(), own[high:].sum()
        return np.array([self.missed, others, *parts]) / LOOK

    def snapshot(self) -> list[Any]:
        return [self.missed, [[k, row] for k, row in sorted(self.given.items())]]

    @classmethod
    def restored(cls, state: Sequence[Any]) -> Answers:
        return cls(float(state[0]), {int(k): np.array(row, np.float64) for k, row in state[1]})


def log_odds(entries: Mapping[int, tuple[int, Answers]]) -> dict[int, float]:
    """Returns by id the log odds that entries (class, answers) of a map are real.

    A mixture of two kinds of entries, real and false, each with its own frequencies of answers, is fitted to all of
    them by expectation maximisation: what a detector's scores are worth follows from how steadily it repeats them at
    the same place. Before there is much to learn from, a real thing is one that most plain views detect. Dawid and
    Skene, "Maximum likelihood estimation of observer error-rates", 1979.
    """
    if not entries:
        return {}
    scores = np.sum([row for _, a in entries.values() for row in a.given.values()], axis=0)
    below = np.cumsum(scores) / max(float(np.sum(scores)), 1e-9)
    low, high = (int(np.searchsorted(below, q)) for q in _THIRDS)
    counts = np.array([answers.counts(class_id, (low, high)) for class_id, answers in entries.values()])
    real, false, share = _REAL, _FALSE, _SHARE
    odds = np.zeros(len(counts))
    for _ in range(_ROUNDS):
        odds = np.log(share / (1 - share)) + counts @ np.log(real / false)
        weight = 1 / (1 + np.exp(-odds.clip(-50, 50)))
        real, false = (_frequencies(w @ counts, prior) for w, prior in ((weight, _REAL), (1 - weight, _FALSE)))
        share = float((weight.sum() + _SHARE * _SHARE_PRIOR) / (len(weight) + _SHARE_PRIOR))
    return dict(zip(entries, odds.tolist(), strict=True))


def _frequencies(counts: Array, prior: Array) -> Array:
    raised = counts + _PRIOR * prior
    return np.asarray(raised / raised.sum())
