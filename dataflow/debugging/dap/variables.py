"""Values of a stopped call, as an editor shows them: a line each, and their parts when they are opened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from typing import Any

import numpy as np

from dataflow.messages.base import Message
from dataflow.messages.display.text import field_text

MOST_PARTS = 200
MOST_CHARACTERS = 400


class Variables:
    """The values that can be opened while a call is stopped, by their references."""

    def __init__(self) -> None:
        self._opened: list[Any] = []

    def reference(self, value: Any) -> int:
        """Returns the reference by which the parts of a value are asked for; 0 where it has none."""
        if next(parts_of(value), None) is None:
            return 0
        self._opened.append(value)
        return len(self._opened)

    def parts(self, reference: int) -> list[dict[str, Any]]:
        """The parts of a value. Raises LookupError for a reference from an earlier stop."""
        if not 0 < reference <= len(self._opened):
            raise LookupError(f"no value {reference} at this stop")
        parts = parts_of(self._opened[reference - 1])
        return [self.shown(name, value) for (name, value), _ in zip(parts, range(MOST_PARTS), strict=False)]

    def shown(self, name: str, value: Any) -> dict[str, Any]:
        """A value as a `Variable` of the protocol."""
        kind = type(value).__name__
        return {"name": name, "value": text_of(value), "type": kind, "variablesReference": self.reference(value)}


def text_of(value: Any) -> str:
    """A value in one line."""
    try:
        text = field_text(value) if isinstance(value, np.ndarray | Message) else repr(value)
    except Exception as error:
        text = f"<{type(value).__name__}, whose repr raises {type(error).__name__}>"
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}…"


def parts_of(value: Any) -> Iterator[tuple[str, Any]]:
    """The parts of a value, by name."""
    match value:
        case str() | bytes() | int() | float() | complex() | None | type() | np.generic():
            return
        case Message():
            yield from value.items()
        case Mapping():
            yield from ((repr(key), part) for key, part in value.items())
        case list() | tuple() | Set():
            yield from ((str(n), part) for n, part in enumerate(value))
        case np.ndarray():
            yield from ((str(n), part) for n, part in enumerate(value if value.ndim else ()))
        case _:
            slots = (n for cls in type(value).__mro__ for n in getattr(cls, "__slots__", ()) if hasattr(value, n))
            names = dict.fromkeys([*getattr(value, "__dict__", {}), *slots])
            yield from ((name, getattr(value, name)) for name in names if not name.startswith("__"))
