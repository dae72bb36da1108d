"""Pairs two streams while they come, keeping only what is not yet decided: for messages too large to keep them all."""

from __future__ import annotations

from bisect import bisect_left
from typing import Generic, TypeVar

from operators.association import mutually_nearest

Found = TypeVar("Found")
Truth = TypeVar("Truth")


class Pairing(Generic[Found, Truth]):
    """Values of two streams, each given in the order of its stamps, paired as `mutually_nearest` pairs whole lists.

    What decides a stamp lies within twice the tolerance of it, so once both streams are known up to some stamp, all
    that is older by that much is settled.
    """

    def __init__(self, tolerance: int) -> None:
        self._tolerance = tolerance
        self._found: list[tuple[int, Found]] = []
        self._truth: list[tuple[int, Truth]] = []
        self._settled: int | None = None
        self.pairs = self.unmatched_found = self.unmatched_truths = 0

    def add_found(self, stamp: int, value: Found) -> None:
        self._found.append((stamp, value))

    def add_truth(self, stamp: int, value: Truth) -> None:
        self._truth.append((stamp, value))

    def settle(self, known: int) -> list[tuple[Found, Truth]]:
        """The pairs decided now that both streams are known up to the stamp `known`; each is given once."""
        return self._pairs(known - 2 * self._tolerance)

    def finish(self) -> list[tuple[Found, Truth]]:
        """The remaining pairs, with nothing more to come."""
        newest = [stamp for stamp, _ in (*self._found[-1:], *self._truth[-1:])]
        return self._pairs(max(newest) + 1) if newest else []

    def _pairs(self, end: int) -> list[tuple[Found, Truth]]:
        """Settles stamps of what was found, and of truths, before `end`."""
        begin = self._settled
        if begin is not None and end <= begin:
            return []
        found, truth = [s for s, _ in self._found], [s for s, _ in self._truth]
        pairs = mutually_nearest(found, truth, self._tolerance)
        # A pair belongs to the span in which its later stamp lies, so it is given once whatever the spans are.
        fresh = [(i, j) for i, j in pairs if _within(max(found[i], truth[j]), begin, end)]
        paired_found, paired_truth = {i for i, _ in pairs}, {j for _, j in pairs}
        self.pairs += len(fresh)
        self.unmatched_found += sum(_within(s, begin, end) for i, s in enumerate(found) if i not in paired_found)
        self.unmatched_truths += sum(_within(s, begin, end) for j, s in enumerate(truth) if j not in paired_truth)
        values = [(self._found[i][1], self._truth[j][1]) for i, j in fresh]
        kept = end - 3 * self._tolerance
        del self._found[: bisect_left(found, kept)], self._truth[: bisect_left(truth, kept)]
        self._settled = end
        return values


def _within(stamp: int, begin: int | None, end: int) -> bool:
    return (begin is None or stamp >= begin) and stamp < end
