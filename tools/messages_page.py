"""The reference page of the message types, written from their declarations.

python tools/messages_page.py > docs/messages.md
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from types import ModuleType

from dataflow.messages.base import ArrayField, Field, Message, ScalarField, message_types

INTRODUCTION = """\
# Messages

<!-- Written by `python tools/messages_page.py > docs/messages.md`; change the declarations, not this page. -->

A message is one immutable, typed value. All have `stamp`: event time, integer nanoseconds since the epoch. They are
imported from `dataflow.messages` and made with keywords; what does not fit its declaration is refused with an error
that names the type and the field.

- SI units and radians, unless a field says otherwise. Frames follow REP 103 and 105; an optical frame is z forward, x
  right, y down.
- Quaternions are (x, y, z, w), of norm 1 within 0.001. They are kept as given, never renormalised.
- Sets of things are parallel arrays: equal letters in the shapes of one message (`N`) are equal lengths, and a list of
  strings said to be "of each" thing is as long as its arrays.
- Arrays are stored C-contiguous, little-endian and read-only, as a copy of what was given; an array of another type is
  converted where nothing but floating-point precision can be lost. NaN and -0.0 are kept bit by bit.
- Two messages are equal when their digests are: schema, stamp and every field, bit by bit.
- Optional fields are None unless given.

What these do not say, [a type of your own](own-messages.md) does.
"""


def families() -> dict[ModuleType, list[type[Message]]]:
    """The built-in message classes by the module that declares them, both in alphabetical order."""
    found: dict[ModuleType, list[type[Message]]] = {}
    for _, cls in sorted(message_types().items()):
        if cls.__module__.startswith("dataflow.messages."):
            found.setdefault(sys.modules[cls.__module__], []).append(cls)
    return dict(sorted(found.items(), key=lambda item: item[0].__name__))


def markdown() -> str:
    """The whole page."""
    groups = families()
    parts = [INTRODUCTION]
    contents = ["| family | types |", "| --- | --- |"]
    for module, classes in groups.items():
        links = ", ".join(f"[{c.SCHEMA}](#{c.SCHEMA.lower()})" for c in classes)
        contents.append(f"| {_sentence(module)} | {links} |")
    parts.append("\n".join(contents) + "\n")
    for module, classes in groups.items():
        parts.append(f"## {_sentence(module)}\n")
        parts.extend(_section(cls) for cls in classes)
    return "\n".join(parts)


def _section(cls: type[Message]) -> str:
    lines = [f"### {cls.SCHEMA}", "", inspect.getdoc(cls) or "", ""]
    lines += ["| field | type | unit | meaning |", "| --- | --- | --- | --- |"]
    lines += [_row(field) for field in cls.FIELDS]
    helpers = list(_helpers(cls))
    if helpers:
        lines += ["", *helpers]
    return "\n".join(lines) + "\n"


def _row(field: Field) -> str:
    if isinstance(field, ArrayField):
        kind, unit = f"{field.dtype_text()} {field.shape_text()}", field.unit
    else:
        kind, unit = {"strs": "list of str"}.get(field.kind, field.kind), ""
        if field.choices:
            kind += ": " + ", ".join(field.choices)
    if field.optional:
        kind += ", optional"
    elif isinstance(field, ScalarField) and field.anchored:
        kind += ", default the anchor's"
    elif not field.required and not isinstance(field, ArrayField):
        kind += ", default " + (repr(field.default) if field.default != () else "empty")
    return f"| `{field.name}` | {kind} |{f' {unit}' if unit else ''} | {field.doc} |"


def _helpers(cls: type[Message]) -> Iterator[str]:
    """A line for each public property and method that the class itself defines, or a base of it that is no message."""
    owners = (*(base for base in cls.__bases__ if not issubclass(base, Message)), cls)
    for name, member in (item for owner in owners for item in vars(owner).items()):
        if name.startswith("_") or name == "validate":
            continue
        if isinstance(member, property):
            yield f"- `.{name}`: {_first_line(member)}"
        elif isinstance(member, classmethod):
            yield f"- `{cls.SCHEMA}.{name}(...)`: {_first_line(member.__func__)}"
        elif inspect.isfunction(member):
            arguments = ", ".join(list(inspect.signature(member).parameters)[1:])
            yield f"- `.{name}({arguments})`: {_first_line(member)}"


def _first_line(thing: object) -> str:
    return (inspect.getdoc(thing) or "").splitlines()[0]


def _sentence(module: ModuleType) -> str:
    return _first_line(module).removesuffix(".")


if __name__ == "__main__":
    sys.stdout.write(markdown())
