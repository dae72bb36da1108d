"""`${}` in a graph file: references to graph parameters and environment variables, and what takes their place."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

from dataflow.graph.problems import Place, Problems
from dataflow.graph.yaml.limits import MAX_NESTING, NESTED_TOO_DEEP, Budget
from dataflow.graph.yaml.tree import UNKNOWN, Entry, Items, Leaf, Table, Tree, describe, measured, moved

REFERENCE = re.compile(r"\$\{[^{}\n]*\}")


@dataclass(frozen=True, slots=True)
class Reference:
    """One `${...}`: `name` or `env:NAME`, and the text after `:-`, if any."""

    name: str
    default: str | None
    place: Place

    @property
    def variable(self) -> str | None:
        """The environment variable that is asked for, or None when it is a graph parameter."""
        return self.name.removeprefix("env:") if self.name.startswith("env:") else None


Lookup = Callable[[Reference], Tree | None]
"""Gives the value of a reference; None when there is none, which it has then reported."""


def substitute(tree: Tree, lookup: Lookup, problems: Problems, budget: Budget, depth: int = 1) -> Tree:
    """The tree with every `${...}` replaced. A value that is one reference keeps its type; `$${` stands for `${`.

    What comes out is charged to `budget`: references multiply.
    """
    budget.charge(tree.place, 1)
    if depth > MAX_NESTING:
        problems.stop(tree.place, NESTED_TOO_DEEP)
    match tree:
        case Items():
            items = tuple(substitute(item, lookup, problems, budget, depth + 1) for item in tree.items)
            return Items(items, tree.place)
        case Table():
            entries = {
                k: Entry(e.key, substitute(e.value, lookup, problems, budget, depth + 1))
                for k, e in tree.entries.items()
            }
            return Table(entries, tree.place)
    if not isinstance(tree.value, str) or "${" not in tree.value:
        return tree
    whole = REFERENCE.fullmatch(tree.value)
    if whole is None:
        return _interpolated(tree, tree.value, lookup, problems, budget)
    reference = _reference(whole[0], tree.place, problems)
    value = lookup(reference)
    if value is None:
        return Leaf(UNKNOWN, tree.place, tree.raw)
    values, levels = measured(value)
    budget.charge(tree.place, values)
    if depth + levels - 1 > MAX_NESTING:
        problems.stop(tree.place, NESTED_TOO_DEEP)
    if isinstance(value, Leaf) and value.place == reference.place:  # a default or a variable: it was given here
        return replace(value, place=tree.place)
    return moved(value, tree.place)


def _interpolated(leaf: Leaf, text: str, lookup: Lookup, problems: Problems, budget: Budget) -> Leaf:
    """A text with references in it, as one text."""
    parts: list[str] = []
    end = 0
    for match in REFERENCE.finditer(text):
        parts.append(text[end : match.start()])
        end = match.end()
        if parts[-1].endswith("$"):
            parts.append(match[0][1:])
            continue
        reference = _reference(match[0], leaf.place, problems)
        value = lookup(reference)
        if value is None:
            return Leaf(UNKNOWN, leaf.place, leaf.raw)
        if not isinstance(value, Leaf):
            what = f"${{{reference.name}}} is {describe(value)}, which cannot stand inside a text"
            problems.add(reference.place, what)
            return Leaf(UNKNOWN, leaf.place, leaf.raw)
        inner = value.value
        parts.append(str(inner).lower() if isinstance(inner, bool) else str(inner))
        budget.charge_text(leaf.place, len(parts[-1]))
    return Leaf("".join(parts) + text[end:], leaf.place, leaf.raw)


def _reference(text: str, around: Place, problems: Problems) -> Reference:
    name, colon, default = text[2:-1].partition(":-")
    lines = problems.texts.get(around.file, ())
    line = lines[around.line - 1] if 0 < around.line <= len(lines) else ""
    column = line.find(text, around.column - 1)
    place = around if column < 0 else Place(around.file, around.line, column + 1, len(text))
    return Reference(name.strip(), default if colon else None, place)
