"""Splits items that have effects together into those that have them alone, by halving."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from dataflow.blame.links import Effect

T = TypeVar("T")


def split(
    items: Sequence[T], shows: Callable[[Sequence[T]], tuple[Effect, ...]], *, cancels: bool = False
) -> Iterator[tuple[Sequence[T], tuple[Effect, ...]]]:
    """Yields those of some items, the last ones first, that have effects alone, by halving; of a part in which none
    does, the shortest run that has, if all of it together has. `cancels`: a part without an effect is split, too, if
    its last item alone has one (a switch that toggles twice)."""
    if not items:
        return
    effects = shows(items)
    if not effects and not (cancels and len(items) > 1 and shows(items[-1:])):
        return
    if len(items) == 1:
        yield items, effects
        return
    half, found = len(items) // 2, False
    for part in (items[half:], items[:half]):
        for each in split(part, shows, cancels=cancels):
            found = True
            yield each
    if not found and effects:
        begin = _furthest(half, lambda n: bool(shows(items[n:])))
        items = items[begin:]
        left_out = _furthest(len(items) - 1, lambda n: bool(shows(items[: len(items) - n])))
        items = items[: len(items) - left_out]
        yield items, shows(items)


def _furthest(most: int, holds: Callable[[int], bool]) -> int:
    """The largest number up to `most` for which it holds, by bisection; it does for 0."""
    low, high = 0, most + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
