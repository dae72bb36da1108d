"""Matches the messages of streams by their stamps. Pure."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

Stamps = npt.NDArray[np.int64]
Direction = Literal["backward", "forward", "nearest"]
DIRECTIONS = ("backward", "forward", "nearest")
NONE = -1
"""The place of a match that is not there."""


def asof(anchor: Stamps, other: Stamps, direction: Direction = "backward", tolerance: int | None = None) -> Stamps:
    """For each stamp of `anchor`, the place in `other` of its match; `NONE` where it has none.

    The match is the newest one at or before (`backward`), the oldest at or after (`forward`), or the nearest one, the
    earlier of two as near; no further away than `tolerance` ns. Of equal stamps in `other` the last counts backward,
    the first forward.
    """
    if direction not in DIRECTIONS:
        raise ValueError(f"direction {direction!r}: expected {', '.join(DIRECTIONS)}")
    order = np.argsort(other, kind="stable").astype(np.int64)
    ordered = other[order]
    before = np.searchsorted(ordered, anchor, "right") - 1
    after = np.searchsorted(ordered, anchor, "left")
    after = np.where(after < len(other), after, NONE)
    if direction == "backward":
        chosen = before
    elif direction == "forward":
        chosen = after
    else:
        chosen = _nearer(anchor, ordered, before, after)
    found = chosen >= 0
    if tolerance is not None and len(other):
        found &= np.abs(ordered[np.maximum(chosen, 0)] - anchor) <= tolerance
    result = np.full(len(anchor), NONE, np.int64)
    result[found] = order[chosen[found]]
    return result


def _nearer(anchor: Stamps, ordered: Stamps, before: Stamps, after: Stamps) -> Stamps:
    """Of the places of the stamps before and after each anchor, the nearer one; the one before at a tie."""
    if not len(ordered):
        return before
    behind = anchor - ordered[np.maximum(before, 0)]
    ahead = ordered[np.maximum(after, 0)] - anchor
    forward = (after >= 0) & ((before < 0) | (ahead < behind))
    return np.where(forward, after, before)
