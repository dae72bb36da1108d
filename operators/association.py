"""Pairing two lists of stamps: each message with at most one of the other list, as joins with a tolerance do."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise


def mutually_nearest(first: Sequence[int], second: Sequence[int], tolerance: int) -> list[tuple[int, int]]:
    """Index pairs (i, j) whose stamps are each other's nearest and at most `tolerance` apart; ties go to the earlier.

    Both lists strictly increase, in nanoseconds. Raises ValueError where one does not.
    """
    for stamps in (first, second):
        for earlier, later in pairwise(stamps):
            if later <= earlier:
                raise ValueError(f"stamps must strictly increase, but {later} follows {earlier}")
    pairs = []
    for i, stamp in enumerate(first):
        j = _nearest(second, stamp)
        if j is not None and abs(second[j] - stamp) <= tolerance and _nearest(first, second[j]) == i:
            pairs.append((i, j))
    return pairs


def _nearest(stamps: Sequence[int], stamp: int) -> int | None:
    """Index of the nearest stamp, the earlier of two equally near; None in an empty list."""
    if not stamps:
        return None
    right = bisect_left(stamps, stamp)
    if right == len(stamps):
        return right - 1
    if right and stamp - stamps[right - 1] <= stamps[right] - stamp:
        return right - 1
    return right
