"""Counts of the aligners that an operator had before a clock jumped back: each jump begins with a new one."""

from __future__ import annotations

from collections import Counter

from dataflow.operator import OperatorSpec
from dataflow.sync import Aligner


class EarlierCounts:
    """The sums over all aligners but the present one."""

    def __init__(self) -> None:
        self.drops: Counter[tuple[str, str]] = Counter()
        """By input and reason."""
        self.late: Counter[str] = Counter()
        """By input."""

    def take(self, old: Aligner, spec: OperatorSpec) -> None:
        """Adds those of an aligner that is given up; what it holds for triggers and batches is dropped with it."""
        self.drops.update(old.drops)
        self.late.update(old.late)
        for held, count in old.buffered().items():
            if count and spec.inputs[held].kind != "sampled":
                self.drops[held, "reset"] += count
