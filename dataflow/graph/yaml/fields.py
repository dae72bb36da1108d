"""Typed reading of a graph file's fields: every getter reports a wrong value where it stands and gives None for it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TypeVar

from dataflow.graph.keys import NAME_RULE, name_fault
from dataflow.graph.problems import Problems, did_you_mean
from dataflow.graph.yaml.tree import UNKNOWN, Items, Leaf, Table, Tree, describe
from dataflow.sync.stamps import parse_duration

Choice = TypeVar("Choice", bound=str)

_BYTES = re.compile(r"(\d+(?:\.\d+)?)\s*(B|kB|MB|GB|KiB|MiB|GiB)")
_BYTE_UNITS = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


class Fields:
    """Reads values; `what` names the field in messages."""

    def __init__(self, problems: Problems) -> None:
        self.problems = problems

    def wrong(self, tree: Tree | None, what: str, expected: str, hint: str = "") -> None:
        """Reports a value that is not as expected; none is no fault."""
        if tree is not None and not (isinstance(tree, Leaf) and tree.value is UNKNOWN):
            self.problems.add(tree.place, f"{what} must be {expected}, not {describe(tree)}", hint)

    def table(self, tree: Tree | None, what: str, known: Iterable[str] | None = None) -> Table | None:
        """A mapping; with `known`, every other key is reported. An empty value is None."""
        if not isinstance(tree, Table):
            self.wrong(tree, what, "a mapping")
            return None
        if known is not None:
            choices = list(known)
            for key, entry in tree.entries.items():
                if key not in choices:
                    hint = did_you_mean(key, choices, "known here")
                    self.problems.add(entry.key.place, f"unknown key {key!r} in {what}", hint)
        return tree

    def text(self, tree: Tree | None, what: str) -> str | None:
        if isinstance(tree, Leaf) and isinstance(tree.value, str):
            return tree.value
        number = isinstance(tree, Leaf) and isinstance(tree.value, int | float)
        self.wrong(tree, what, "a text", f"write {tree.raw!r} in quotes" if number and isinstance(tree, Leaf) else "")
        return None

    def texts(self, tree: Tree | None, what: str) -> list[Leaf]:
        """A text or a list of texts, as leaves."""
        if tree is None:
            return []
        items = tree.items if isinstance(tree, Items) else (tree,)
        return [Leaf(word, item.place, word) for item in items if (word := self.text(item, what)) is not None]

    def integer(self, tree: Tree | None, what: str, low: int, high: int) -> int | None:
        if isinstance(tree, Leaf) and type(tree.value) is int and low <= tree.value <= high:
            return tree.value
        self.wrong(tree, what, f"a whole number from {low} to {high}")
        return None

    def boolean(self, tree: Tree | None, what: str) -> bool | None:
        if isinstance(tree, Leaf) and isinstance(tree.value, bool):
            return tree.value
        self.wrong(tree, what, "true or false")
        return None

    def duration(self, tree: Tree | None, what: str) -> int | None:
        """Nanoseconds of a duration with a unit; a bare number is refused."""
        if isinstance(tree, Leaf) and isinstance(tree.value, str):
            try:
                return parse_duration(tree.value)
            except ValueError as error:
                self.problems.add(tree.place, f"{what}: {error}")
                return None
        self.wrong(tree, what, "a duration with a unit, such as 100ms")
        return None

    def size(self, tree: Tree | None, what: str) -> int | None:
        """Bytes, from `512MiB`, `2GB` or a plain number of bytes."""
        if isinstance(tree, Leaf) and type(tree.value) is int and tree.value > 0:
            return tree.value
        if isinstance(tree, Leaf) and isinstance(tree.value, str) and (match := _BYTES.fullmatch(tree.value.strip())):
            return int(float(match[1]) * _BYTE_UNITS[match[2]])
        self.wrong(tree, what, "a size such as 512MiB or 2GB")
        return None

    def choice(self, tree: Tree | None, what: str, choices: Mapping[str, Choice]) -> Choice | None:
        if isinstance(tree, Leaf) and isinstance(tree.value, str) and tree.value in choices:
            return choices[tree.value]
        word = str(tree.value) if isinstance(tree, Leaf) else ""
        self.wrong(tree, what, f"one of {', '.join(choices)}", did_you_mean(word, choices))
        return None

    def namespace(self, tree: Tree | None) -> str | None:
        """Names joined by '/'."""
        leaf = self.path(tree, "namespace")
        for part in leaf.value.split("/") if leaf else ():
            if leaf and (fault := name_fault(part)):
                hint = f"names joined by '/', such as robot1 or site/robot1; {NAME_RULE}"
                self.problems.add(leaf.place, f"namespace {leaf.value!r}: {fault}", hint)
                return None
        return leaf.value if leaf else None

    def path(self, tree: Tree | None, what: str) -> Leaf | None:
        """A path, with its place."""
        word = self.text(tree, what)
        return None if word is None or tree is None else Leaf(word, tree.place, word)

    def label(self, tree: Tree | None, what: str, kind: str = "label") -> Leaf | None:
        """A name of one part, without '/', with its place."""
        leaf = self.path(tree, what)
        if leaf and (fault := name_fault(leaf.value)):
            self.problems.add(leaf.place, f"{what} {kind} {fault}", NAME_RULE)
            return None
        return leaf
