"""A graph file as a tree of values that know their line and column."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from dataflow.graph.problems import Place


@dataclass(frozen=True, slots=True)
class Leaf:
    """A scalar: its value, and the text as it stood in the file."""

    value: Any
    place: Place
    raw: str = ""


@dataclass(frozen=True, slots=True)
class Items:
    """A list."""

    items: tuple[Tree, ...]
    place: Place


@dataclass(frozen=True, slots=True)
class Entry:
    """One `key: value` of a mapping."""

    key: Leaf
    value: Tree


@dataclass(frozen=True, slots=True)
class Table:
    """A mapping; keys are text."""

    entries: dict[str, Entry]
    place: Place

    def get(self, key: str) -> Tree | None:
        entry = self.entries.get(key)
        return None if entry is None else entry.value


Tree = Leaf | Items | Table


def plain(tree: Tree) -> Any:
    """The tree as ordinary Python values."""
    match tree:
        case Leaf():
            return tree.value
        case Items():
            return [plain(item) for item in tree.items]
        case Table():
            return {key: plain(entry.value) for key, entry in tree.entries.items()}


def at(tree: Tree, path: tuple[str | int, ...]) -> Tree:
    """The value at `path`, or the nearest one above it that exists."""
    for step in path:
        if isinstance(tree, Table) and str(step) in tree.entries:
            tree = tree.entries[str(step)].value
        elif isinstance(tree, Items) and isinstance(step, int) and step < len(tree.items):
            tree = tree.items[step]
        else:
            break
    return tree


def moved(tree: Tree, place: Place) -> Tree:
    """The tree as if all of it stood at `place`, which then records where each value was given."""
    here = replace(place, given=tree.place.given or tree.place)
    match tree:
        case Leaf():
            return replace(tree, place=here)
        case Items():
            return Items(tuple(moved(item, place) for item in tree.items), here)
        case Table():
            return Table(
                {k: Entry(replace(e.key, place=here), moved(e.value, place)) for k, e in tree.entries.items()}, here
            )


def describe(tree: Tree) -> str:
    """Returns what a value is, for messages: `text 'abc'`, `number 3`, `a list`."""
    match tree:
        case Items():
            return "a list"
        case Table():
            return "a mapping"
        case Leaf(value=None):
            return "nothing"
        case Leaf(value=bool()):
            return f"{str(tree.value).lower()}"
        case Leaf(value=int() | float()):
            return f"the number {tree.value}"
    return f"the text {tree.value!r}"


def measured(tree: Tree) -> tuple[int, int]:
    """(number of values, levels) of a tree."""
    match tree:
        case Leaf():
            return 1, 1
        case Items():
            inner = [measured(item) for item in tree.items]
        case Table():
            inner = [measured(entry.value) for entry in tree.entries.values()]
    return 1 + sum(values for values, _ in inner), 1 + max((levels for _, levels in inner), default=0)


class _Unknown:
    """Stands for a value that could not be had, so that nothing further is said about it."""

    def __repr__(self) -> str:
        return "unknown"


UNKNOWN = _Unknown()


def unknown(tree: Tree) -> bool:
    """True when the value, or something inside it, could not be had (which is reported already)."""
    match tree:
        case Leaf():
            return tree.value is UNKNOWN
        case Items():
            return any(unknown(item) for item in tree.items)
        case Table():
            return any(unknown(entry.value) for entry in tree.entries.values())
