"""Paired comparison of figures: the same recordings by two choices of settings."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.records.figures import words_of
from dataflow.sweep.plan import Task
from dataflow.sweep.table import Store

DRAWS = 10_000
"""Samples of the recordings, with replacement, from which an interval is taken."""
BLOCK = 1 << 20
"""Numbers drawn at a time."""
LOWER_IS_BETTER = frozenset({"error", "rmse", "ate", "rpe", "drift", "lost", "dropped", "unmatched"})
HIGHER_IS_BETTER = frozenset({"precision", "recall", "f1", "ap50", "iou", "miou", "accuracy"})
FloatArray = NDArray[np.float64]
ALPHA = 0.05
SPREAD = 3
"""Recordings from which an interval is taken."""


@dataclass(frozen=True, slots=True)
class Paired:
    """A figure by A and by B on the same recordings.

    - `a`, `b`: means; `difference`: mean of B - A; `low`, `high`: its 95 % interval, by bootstrap over recordings; None
      for fewer than three, of which samples show no spread.
    - `p`: of Wilcoxon's signed-rank test, two-sided; `adjusted`: by Holm's method, for all figures compared.
    - `recordings`: (name, B - A), the worst for B first; the largest first where no word of the figure's name gives a
      direction (`directed`).
    - `left_out`: recordings where A or B has no such figure, or one that is not finite.
    """

    figure: str
    a: float
    b: float
    difference: float
    low: float | None
    high: float | None
    p: float
    adjusted: float
    recordings: tuple[tuple[str, float], ...]
    directed: bool
    left_out: tuple[str, ...] = ()

    @property
    def differs(self) -> bool:
        """Returns whether B differs from A at 5 %, among all figures compared."""
        return self.adjusted < ALPHA

    @property
    def most_changed(self) -> list[str]:
        """Returns the names of the recordings, first those that change the most in the direction of `difference`."""
        by = sorted(self.recordings, key=lambda pair: pair[1], reverse=self.difference > 0)
        return [name for name, _ in by]


@dataclass(frozen=True, slots=True)
class Difference:
    """An operator whose streams differ.

    `recordings`: in how many. `first`: in how many it is the first of the graph that does.
    """

    operator: str
    recordings: int
    first: int


def compared(figures: Mapping[str, Mapping[str, tuple[float, float]]]) -> list[Paired]:
    """Compares every figure: name → recording → (by A, by B), NaN for one that is missing. The least p comes first.

    Source: Wilcoxon 1945; Holm 1979; Efron 1979 (percentile interval).
    """
    found = [
        _paired(name, pairs) for name, pairs in figures.items() if np.isfinite([*pairs.values()]).all(axis=1).any()
    ]
    found.sort(key=lambda one: (one.p, one.figure))
    least, adjusted = 0.0, []
    for rank, one in enumerate(found):
        least = max(least, min(1.0, one.p * (len(found) - rank)))
        adjusted.append(Paired(**{**{n: getattr(one, n) for n in Paired.__slots__}, "adjusted": least}))
    return adjusted


def least_p(recordings: int, figures: int) -> float:
    """Returns the smallest adjusted p that so many pairs can have: all differ in one direction. At least `ALPHA` means
    that no difference can be shown."""
    return min(1.0, 2.0 ** (1 - recordings) * figures)


def needed(figures: int) -> int:
    """Returns the number of recordings from which a difference can be shown among so many figures."""
    return next(count for count in itertools.count(1) if least_p(count, figures) < ALPHA)


def unlike(first: Sequence[Task], second: Sequence[Task]) -> tuple[list[Task], list[Task], dict[str, str]]:
    """Returns the tasks by A and B without those of recordings that hold the same bytes as another, and these copies:
    name → that of the recording that stands for it. A copy is no further evidence."""
    seen: dict[str, str] = {}
    copies = {}
    for task in first:
        if (name := seen.setdefault(task.source.digest, task.source.name)) != task.source.name:
            copies[task.source.name] = name
    a, b = ([task for task in tasks if task.source.name not in copies] for tasks in (first, second))
    return a, b, copies


def _paired(figure: str, given: Mapping[str, tuple[float, float]]) -> Paired:
    from scipy.stats import wilcoxon

    pairs = {name: pair for name, pair in given.items() if np.isfinite(pair).all()}
    values = np.array(list(pairs.values()), float)
    differences = values[:, 1] - values[:, 0]
    low, high = _interval(differences)
    p = float(wilcoxon(differences).pvalue) if differences.any() else 1.0
    lower, higher = bool(LOWER_IS_BETTER & words_of(figure)), bool(HIGHER_IS_BETTER & words_of(figure))
    named = list(zip(pairs, differences.tolist(), strict=True))
    named.sort(key=lambda pair: (-pair[1] if lower else pair[1] if higher else -abs(pair[1]), pair[0]))
    a, b = values.mean(axis=0).tolist()
    left_out = tuple(name for name in given if name not in pairs)
    mean = float(differences.mean())
    return Paired(figure, a, b, mean, low, high, p, p, tuple(named), lower or higher, left_out)


def _interval(differences: FloatArray) -> tuple[float, float] | tuple[None, None]:
    if len(differences) < SPREAD:
        return None, None
    low, high = np.quantile(_means(differences), (0.025, 0.975)).tolist()
    return low, high


def _means(differences: FloatArray) -> FloatArray:
    """Returns the means of samples with replacement, some at a time, so that many recordings take little memory."""
    draw, count = np.random.default_rng(0), len(differences)
    sizes = [min(step, DRAWS - begin) for step in [max(1, BLOCK // count)] for begin in range(0, DRAWS, step)]
    return np.concatenate([differences[draw.integers(count, size=(size, count))].mean(axis=1) for size in sizes])


def figures_of(
    first: Iterable[Task], second: Iterable[Task], store: Store
) -> dict[str, dict[str, tuple[float, float]]]:
    """Returns the figures of recordings that both ran: "operator: name" → recording → (by A, by B), NaN for none."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for task, other in zip(first, second, strict=True):
        a, b = _figures(store, task), _figures(store, other)
        for name in a.keys() | b.keys():
            found.setdefault(name, {})[task.source.name] = (a.get(name, math.nan), b.get(name, math.nan))
    return dict(sorted(found.items()))


def _figures(store: Store, task: Task) -> dict[str, float]:
    return {f"{row['operator']}: {name}": v for row in _rows(store, task) for name, v in row.get("figures", {}).items()}


def _rows(store: Store, task: Task) -> Sequence[Mapping[str, Any]]:
    result = store.of(task.key)
    return result.rows if result is not None and result.outcome == "done" else ()


def differing(first: Iterable[Task], second: Iterable[Task], store: Store, order: Sequence[str]) -> list[Difference]:
    """Returns the operators whose streams differ, in `order` of the graph: causes before what follows from them."""
    place = {name: number for number, name in enumerate(order)}
    recordings: dict[str, int] = {}
    firsts: dict[str, int] = {}
    for task, other in zip(first, second, strict=True):
        a = {row["operator"]: row.get("digest") for row in _rows(store, task) if "operator" in row}
        b = {row["operator"]: row.get("digest") for row in _rows(store, other) if "operator" in row}
        names = sorted((n for n in a.keys() & b.keys() if a[n] != b[n]), key=lambda n: place.get(n, len(place)))
        for name in names:
            recordings[name] = recordings.get(name, 0) + 1
        for name in names[:1]:
            firsts[name] = firsts.get(name, 0) + 1
    names = sorted(recordings, key=lambda name: place.get(name, len(place)))
    return [Difference(name, recordings[name], firsts.get(name, 0)) for name in names]
