"""The reference page of the Python interface, written from docstrings and signatures.

python tools/api_page.py > docs/api.md
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Iterator
from functools import cached_property
from typing import Any

INTRODUCTION = """\
# Python interface

<!-- Written by `python tools/api_page.py > docs/api.md`; change the docstrings, not this page. -->

What programs and notebooks use, by the module that it is imported from. [From Python](python.md) shows it at work;
[writing an operator](writing-an-operator.md) is a tutorial; [messages](messages.md) and [operators](operators.md) have
reference pages of their own.
"""

SECTIONS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Recordings", "dataflow", ("open", "RecordedStreams", "RecordedStream", "Joined")),
    ("Graphs and runs", "dataflow", ("Graph", "run", "replay", "launch", "verify", "Session", "RunResult", "Verified")),
    ("One operator on streams", "dataflow", ("play", "Played")),
    (
        "Writing operators",
        "dataflow.operator",
        ("Operator", "Source", "In", "Sampled", "Batch", "Out", "Param", "Context"),
    ),
    ("Declaring messages", "dataflow.messages", ("Message", "scalar", "array", "message_types")),
    (
        "Recording files",
        "dataflow.recording",
        ("Recording", "Recorded", "StreamInfo", "RecordingWriter", "register_decoder", "ForeignDecoder", "diff"),
    ),
    ("Graph files", "dataflow.graph", ("load_graph", "load_text", "GraphError")),
)
"""Title, module, and the names in the order of the page."""


NOT_MADE = (
    "RecordedStreams", "RecordedStream", "Joined", "RunResult", "Verified", "Played", "Recorded", "StreamInfo",
    "Context", "GraphError",
)  # fmt: skip
"""Classes whose objects are given, not made."""
LINE = 100
"""Signatures that are longer have a line for each parameter."""


def markdown() -> str:
    """The whole page."""
    parts = [INTRODUCTION, _contents()]
    for title, module, names in SECTIONS:
        parts.append(f"## {title}\n")
        parts += [section(module, name) for name in names]
    return "\n".join(parts)


def _contents() -> str:
    lines = ["| import from | names |", "| --- | --- |"]
    for _, module, names in SECTIONS:
        links = ", ".join(f"[{name}](#{_anchor(module, name)})" for name in names)
        lines.append(f"| `{module}` | {links} |")
    return "\n".join(lines) + "\n"


def _anchor(module: str, name: str) -> str:
    return f"{module}.{name}".replace(".", "").lower()


def section(module: str, name: str) -> str:
    """The part of the page for one name."""
    thing = getattr(importlib.import_module(module), name)
    lines = [f"### {module}.{name}", ""]
    if name not in NOT_MADE:
        lines += ["```python", _wrapped(f"{name}{signature(thing)}", thing), "```", ""]
    lines += [documentation(thing, f"{module}.{name}"), ""]
    if inspect.isclass(thing):
        for member, value in members(thing):
            lines += [_entry(member, value, f"{module}.{name}.{member}"), ""]
    return "\n".join(lines)


def _wrapped(text: str, thing: Any) -> str:
    if len(text) <= LINE:
        return text
    head, tail = text[: text.index("(")], _returns(thing, inspect.signature(thing))
    return "\n".join([f"{head}(", *(f"    {word}," for word in _parameters(thing)), f"){tail}"])


def members(cls: type) -> Iterator[tuple[str, Any]]:
    """The public methods and properties that a class defines itself, in their order."""
    for name, value in vars(cls).items():
        if not name.startswith("_") and _is_documented_kind(value):
            yield name, value


def _is_documented_kind(value: Any) -> bool:
    return isinstance(value, property | cached_property | classmethod | staticmethod) or inspect.isfunction(value)


def _entry(name: str, value: Any, path: str) -> str:
    if isinstance(value, property | cached_property):
        head = f"`.{name}`"
    else:
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        head = f"`.{name}{signature(function)}`"
    text = documentation(value, path).split("\n")
    return "\n".join([f"- {head}: {text[0]}", *(f"  {line}".rstrip() for line in text[1:])])


def documentation(thing: Any, path: str) -> str:
    """The docstring. Raises `ValueError` for a thing that has none."""
    if isinstance(thing, cached_property | classmethod | staticmethod):
        thing = getattr(thing, "func", None) or thing.__func__
    text = inspect.getdoc(thing)
    if not text or (dataclasses.is_dataclass(thing) and text.startswith(f"{getattr(thing, '__name__', '')}(")):
        raise ValueError(f"{path} has no docstring")
    return text


def signature(thing: Any) -> str:
    """The parameters with their types as the source has them, without `self`."""
    return f"({', '.join(_parameters(thing))})" + _returns(thing, inspect.signature(thing))


def _parameters(thing: Any) -> list[str]:
    words: list[str] = []
    starred = False
    for parameter in inspect.signature(thing).parameters.values():
        if parameter.name in ("self", "cls"):
            continue
        if parameter.kind is parameter.VAR_POSITIONAL:
            starred = True
        elif parameter.kind is parameter.KEYWORD_ONLY and not starred:
            words.append("*")
            starred = True
        words.append(_parameter(parameter))
    return words


def _parameter(parameter: inspect.Parameter) -> str:
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
    text = stars + parameter.name
    annotated = parameter.annotation is not parameter.empty
    if annotated:
        text += f": {_type(parameter.annotation)}"
    if parameter.default is not parameter.empty:
        default = parameter.default
        shown = default.__name__ if inspect.isfunction(default) else "..." if type(default) is object else repr(default)
        text += f" = {shown}" if annotated else f"={shown}"
    return text


def _returns(thing: Any, found: inspect.Signature) -> str:
    if inspect.isclass(thing) or found.return_annotation in (found.empty, None, "None"):
        return ""
    return f" -> {_type(found.return_annotation)}"


def _type(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))


if __name__ == "__main__":
    sys.stdout.write(markdown())
