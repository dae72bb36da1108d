"""Score of activities: the mean over classes of F1."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from operators.scene.graph.agents import UNKNOWN


def macro_f1(true: Sequence[str], said: Sequence[str]) -> float:
    """Returns the mean of F1 over all classes that are true or said at any time; 0 where there are none.

    A class that is said and never true counts 0, as in scikit-learn. `unknown` is an answer and no class: a miss of the
    true class, and false for none.
    """
    pairs = Counter(zip(true, said, strict=True))
    scores = []
    for name in sorted({*true, *said} - {UNKNOWN}):
        hit = pairs[name, name]
        false = sum(n for (t, s), n in pairs.items() if s == name != t)
        miss = sum(n for (t, s), n in pairs.items() if t == name != s)
        scores.append(2 * hit / (2 * hit + false + miss))
    return sum(scores) / len(scores) if scores else 0.0
