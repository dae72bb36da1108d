"""Score of activities: the mean over classes of F1."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence


def macro_f1(true: Sequence[str], said: Sequence[str]) -> float:
    """Returns the mean over the classes that are true at any time of F1; 0 where there are none.

    What is said and is no class, such as `unknown`, is a miss of the true class and false for none.
    """
    pairs = Counter(zip(true, said, strict=True))
    scores = []
    for name in sorted(set(true)):
        hit = pairs[name, name]
        false = sum(n for (t, s), n in pairs.items() if s == name != t)
        miss = sum(n for (t, s), n in pairs.items() if t == name != s)
        scores.append(2 * hit / (2 * hit + false + miss))
    return sum(scores) / len(scores) if scores else 0.0
