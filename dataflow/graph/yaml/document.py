"""Reads YAML with marks: the text of a graph file becomes a tree of values that know their line and column.

The language is YAML 1.2 less its surprises: no tags, directives, merge keys, NaN, octal-looking `010`, or second
documents. `${name}` may stand unquoted inside `{...}` and `[...]`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent
from ruamel.yaml.nodes import MappingNode, ScalarNode
from ruamel.yaml.nodes import Node as YamlNode
from ruamel.yaml.reader import ReaderError

from dataflow.graph.problems import Place, Problems
from dataflow.graph.yaml.limits import MAX_DIGITS, MAX_NESTING, MAX_TEXT, MAX_VALUES, NESTED_TOO_DEEP
from dataflow.graph.yaml.references import REFERENCE
from dataflow.graph.yaml.tree import UNKNOWN, Entry, Items, Leaf, Table, Tree

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
    hidden = REFERENCE.sub(lambda match: match[0].translate(_HIDE), text)
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
