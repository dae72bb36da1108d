"""Delta debugging: the smallest part of a list that still shows something.

Zeller and Hildebrandt, Simplifying and isolating failure-inducing input, 2002: `ddmin`, behind a search for the
shortest end of the list, since the latest inputs matter most.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


def shortest_end(items: Sequence[T], shows: Callable[[Sequence[T]], bool], grows: int = 2) -> Sequence[T]:
    """The shortest end of `items`, of 0, 1, `grows`, its square... of them, that shows it; all where none of these
    does."""
    size = 0
    while size < len(items):
        if shows(items[len(items) - size :]):
            return items[len(items) - size :]
        size = grows * size or 1
    return items


def smallest(items: Sequence[T], shows: Callable[[Sequence[T]], bool]) -> Sequence[T]:
    """A part of `items`, in their order, that shows it, and does no more without any one of its items.

    `items` show it; `shows` is asked about parts, and False once the time is up.
    """
    if shows(()):
        return ()
    left, parts = list(items), 2
    while len(left) >= 2:
        size = -(-len(left) // parts)
        cuts = [(k, min(k + size, len(left))) for k in range(0, len(left), size)]
        found = next((left[a:b] for a, b in cuts if len(cuts) > 2 and shows(left[a:b])), None)
        if found is not None:
            left, parts = found, 2
            continue
        found = next((left[:a] + left[b:] for a, b in cuts if shows(left[:a] + left[b:])), None)
        if found is not None:
            left, parts = found, max(parts - 1, 2)
        elif parts >= len(left):
            break
        else:
            parts = min(2 * parts, len(left))
    return left


def needed(items: Sequence[T], shows: Callable[[Sequence[T]], bool]) -> Sequence[T]:
    """A part of `items`, in their order, that shows it, by bisection: about log2(len(items)) questions for each item.

    `items` show it. The next one found is the first item of the shortest end that shows it, together with those found
    before. All of them are needed if more items never take the effect away; else `smallest` leaves some out.
    """
    found: list[T] = []
    left = list(items)
    while not shows(found):
        does, does_not = 0, len(left)
        while does_not - does > 1:
            middle = (does + does_not) // 2
            does, does_not = (middle, does_not) if shows([*found, *left[middle:]]) else (does, middle)
        found, left = [*found, left[does]], left[does + 1 :]
        if not left:
            break
    return found


def thinned(items: Sequence[T], shows: Callable[[Sequence[T]], bool]) -> Sequence[T]:
    """Every other one of `items`, which show it, again and again as long as these show it."""
    left = items
    while len(left) > 1:
        half = next((part for part in (left[1::2], left[::2]) if shows(part)), None)
        if half is None:
            break
        left = half
    return left


def none_to_spare(items: Sequence[T], shows: Callable[[Sequence[T]], bool]) -> Sequence[T]:
    """As `smallest`, by leaving out one after the other, the last one first: quicker where most of `items` are
    needed."""
    left, at, kept = list(items), len(items) - 1, 0
    while left and kept < len(left):
        rest = left[:at] + left[at + 1 :]
        if shows(rest):
            left, kept = rest, 0
        else:
            kept += 1
        at = (at - 1) % max(len(left), 1)
    return left
