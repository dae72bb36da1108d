"""YAML with marks: a graph file as a tree of values that know their line and column, and `${}` substitution in it.

The language is YAML 1.2 less its surprises: no tags, directives, merge keys, NaN, octal-looking `010`, or second
documents. `${name}` may stand unquoted inside `{...}` and `[...]`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent
from ruamel.yaml.nodes import MappingNode, ScalarNode
from ruamel.yaml.nodes import Node as YamlNode
from ruamel.yaml.reader import ReaderError

from dataflow.graph.limits import MAX_DIGITS, MAX_NESTING, MAX_TEXT, MAX_VALUES, Budget
from dataflow.graph.problems import Place, Problems


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

NESTED_TOO_DEEP = f"values nest deeper than {MAX_NESTING} levels"
_REFERENCE = re.compile(r"\$\{[^{}\n]*\}")
_FLOW = "{}[],:#"
_HIDDEN = "".join(chr(0xF8D0 + i) for i in range(len(_FLOW)))
_HIDE, _SHOW = str.maketrans(_FLOW, _HIDDEN), str.maketrans(_HIDDEN, _FLOW)


def parse(text: str, file: str, problems: Problems, lines: Sequence[str] = ()) -> Tree | None:
    """The tree of a YAML text; None when it has no value or a fault, which is then in `problems`.

    `lines` is what messages show instead of the text's own lines.
    """
    start = Place(file, 1, 1)
    if len(text) > MAX_TEXT:
        problems.stop(start, f"the file has more than {MAX_TEXT:,} characters, which is the limit")
    problems.texts[file] = lines or text.replace("\r\n", "\n").split("\n")
    if any(c in text for c in _HIDDEN):
        problems.add(start, f"the characters U+F8D0 to U+{ord(_HIDDEN[-1]):04X} are not allowed in a graph file")
        return None
    for number, line in enumerate(problems.texts[file], 1):
        if line.startswith("%"):
            problems.add(Place(file, number, 1, len(line)), "YAML directives are not part of the graph language")
            return None
    hidden = _REFERENCE.sub(lambda match: match[0].translate(_HIDE), text)
    try:
        node = _yaml().compose(hidden)
    except MarkedYAMLError as error:
        _syntax(error, file, problems)
        return None
    except ReaderError as error:
        row = text.count("\n", 0, error.position) + 1
        column = error.position - text.rfind("\n", 0, error.position)
        problems.add(Place(file, row, column), f"character U+{ord(text[error.position]):04X} is not allowed")
        return None
    except RecursionError:
        problems.add(_too_deep(hidden, file), NESTED_TOO_DEEP)
        return None
    except YAMLError as error:
        problems.add(start, f"not readable as YAML: {type(error).__name__}: {error}")
        return None
    if node is None:
        return None
    return _Builder(file, problems).build(node)


def _yaml() -> YAML:
    reader = YAML(typ="safe", pure=True)
    reader.composer.warn_double_anchors = False
    return reader


def _too_deep(text: str, file: str) -> Place:
    """The first value below more than `MAX_NESTING` others."""
    depth = 0
    for event in _yaml().parse(text):
        if isinstance(event, CollectionStartEvent):
            depth += 1
            if depth > MAX_NESTING:
                return Place(file, event.start_mark.line + 1, event.start_mark.column + 1)
        elif isinstance(event, CollectionEndEvent):
            depth -= 1
    return Place(file, 1, 1)


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
    """The tree as if all of it stood at `place`."""
    match tree:
        case Leaf():
            return replace(tree, place=place)
        case Items():
            return Items(tuple(moved(item, place) for item in tree.items), place)
        case Table():
            return Table(
                {k: Entry(replace(e.key, place=place), moved(e.value, place)) for k, e in tree.entries.items()}, place
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
    whole = _REFERENCE.fullmatch(tree.value)
    if whole is None:
        return _interpolated(tree, tree.value, lookup, problems, budget)
    value = lookup(_reference(whole[0], tree.place, problems))
    if value is None:
        return Leaf(UNKNOWN, tree.place, tree.raw)
    values, levels = _measured(value)
    budget.charge(tree.place, values)
    if depth + levels - 1 > MAX_NESTING:
        problems.stop(tree.place, NESTED_TOO_DEEP)
    return moved(value, tree.place)


def _interpolated(leaf: Leaf, text: str, lookup: Lookup, problems: Problems, budget: Budget) -> Leaf:
    """A text with references in it, as one text."""
    parts: list[str] = []
    end = 0
    for match in _REFERENCE.finditer(text):
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


def _measured(tree: Tree) -> tuple[int, int]:
    """(number of values, levels) of a tree."""
    match tree:
        case Leaf():
            return 1, 1
        case Items():
            inner = [_measured(item) for item in tree.items]
        case Table():
            inner = [_measured(entry.value) for entry in tree.entries.values()]
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


def parse_scalar(text: str, place: Place) -> Leaf:
    """The text of an environment variable or of a default, as YAML reads a scalar; anything else is a text."""
    try:
        node = _yaml().compose(text)
    except (YAMLError, RecursionError):
        return Leaf(text, place, text)
    if not isinstance(node, ScalarNode):
        return Leaf("" if node is None else text, place, text)
    scratch = Problems()
    leaf = _Builder(place.file, scratch).build(node)
    assert isinstance(leaf, Leaf)
    return Leaf(text if scratch.found else leaf.value, place, text)


def _reference(text: str, around: Place, problems: Problems) -> Reference:
    name, colon, default = text[2:-1].partition(":-")
    lines = problems.texts.get(around.file, ())
    line = lines[around.line - 1] if 0 < around.line <= len(lines) else ""
    column = line.find(text, around.column - 1)
    place = around if column < 0 else Place(around.file, around.line, column + 1, len(text))
    return Reference(name.strip(), default if colon else None, place)


def _quoted(raw: str) -> str:
    return f"{raw!r} in quotes for a text" if len(raw) <= 40 else "it in quotes for a text"


def _syntax(error: MarkedYAMLError, file: str, problems: Problems) -> None:
    mark = error.problem_mark or error.context_mark
    place = Place(file, 1, 1) if mark is None else Place(file, mark.line + 1, mark.column + 1)
    what = str(error.problem or error.context).replace("<stream end>", "the end of the file").translate(_SHOW)
    hint = ""
    if "\\t" in what or "tab" in what:
        hint = "indent with spaces"
    elif "mapping values are not allowed" in what:
        hint = "a text with ': ' in it needs quotes; or the line is indented too far"
    elif "another document" in what:
        what, hint = "a second document begins here", "a graph file holds one document: remove the '---'"
    related = []
    context = error.context_mark
    if error.context and context is not None and (context.line, context.column) != (place.line - 1, place.column - 1):
        related = [(Place(file, context.line + 1, context.column + 1), error.context)]
    problems.add(place, f"not readable as YAML: {what}", hint, related)


class _Builder:
    """Turns ruamel's composed nodes into our tree, and refuses what the language leaves out."""

    def __init__(self, file: str, problems: Problems) -> None:
        self.file, self.problems = file, problems
        self.lines = problems.texts.get(file, [])
        self.count = 0
        self.open: list[YamlNode] = []

    def build(self, node: YamlNode) -> Tree:
        place = self.place(node)
        self.count += 1
        if any(node is outer for outer in self.open):
            self.problems.add(place, "an alias (*) refers to the value it is part of")
            return Leaf(UNKNOWN, place)
        if self.count > MAX_VALUES:
            self.problems.stop(place, f"the file has more than {MAX_VALUES:,} values", "aliases (*) multiply them")
        if len(self.open) >= MAX_NESTING:
            self.problems.stop(place, NESTED_TOO_DEEP)
        tag = str(node.tag).removeprefix("tag:yaml.org,2002:")
        if isinstance(node, ScalarNode):
            return self.scalar(node, tag, place)
        if tag not in ("map", "seq"):
            self.problems.add(place, f"tags ({node.tag}) are not part of the graph language")
            return Leaf(UNKNOWN, place)
        self.open.append(node)
        try:
            if isinstance(node, MappingNode):
                return Table(dict(self.entries(node)), place)
            return Items(tuple(self.build(item) for item in node.value), place)
        finally:
            self.open.pop()

    def entries(self, node: MappingNode) -> Iterator[tuple[str, Entry]]:
        seen: dict[str, Place] = {}
        for key, value in node.value:
            place = self.place(key)
            if not isinstance(key, ScalarNode):
                self.problems.add(place, "a key must be a word", "did you forget quotes around '${...}' or '{...}'?")
                continue
            name = key.value.translate(_SHOW)
            if name == "<<" and key.style is None:
                self.problems.add(place, "merge keys (<<) are not part of the graph language", "use graph parameters")
                continue
            if name in seen:
                self.problems.add(place, f"duplicate key {name!r}", related=[(seen[name], "first given here")])
                continue
            seen[name] = place
            yield name, Entry(Leaf(name, place, name), self.build(value))

    def scalar(self, node: ScalarNode, tag: str, place: Place) -> Leaf:
        raw = str(node.value).translate(_SHOW)
        text = raw.replace("_", "").lower()
        value: Any = raw
        match tag:
            case "null":
                value = None
            case "bool":
                value = text == "true"
            case "int":
                digits = text.lstrip("+-")
                if len(digits) > 1 and digits[0] == "0" and digits.isdigit():
                    return self.refuse(
                        place, f"{raw} is octal to some and decimal to others", f"write {int(digits)} or {raw!r}"
                    )
                if len(digits) > MAX_DIGITS or not -(2**63) <= (value := int(text, 0)) < 2**64:
                    return self.refuse(place, "whole numbers have 64 bits: this one has more", f"write {_quoted(raw)}")
            case "float":
                value = float(text.replace(".inf", "inf").replace(".nan", "nan"))
                if math.isnan(value):
                    return self.refuse(place, "NaN (not a number) is no value", "leave it out, or give a number")
            case "str" | "timestamp" | "value":
                value = raw
            case _:
                return self.refuse(place, f"tags ({node.tag}) are not part of the graph language", "remove the tag")
        return Leaf(value, place, raw)

    def refuse(self, place: Place, message: str, hint: str) -> Leaf:
        self.problems.add(place, message, hint)
        return Leaf(UNKNOWN, place)

    def place(self, node: YamlNode) -> Place:
        start, end = node.start_mark, node.end_mark
        if start.line == end.line:
            width = end.column - start.column
        else:
            line = self.lines[start.line] if start.line < len(self.lines) else ""
            width = len(line.rstrip()) - start.column
        return Place(self.file, start.line + 1, start.column + 1, max(1, width))
