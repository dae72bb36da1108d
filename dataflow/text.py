"""Makes text from outside fit for a terminal."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Callable
from typing import Any

_HIDDEN = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))
"""Unicode categories: control, format (such as a change of direction), surrogate, line and paragraph separator."""
_WITHIN_LINES = re.compile(r"[^\t\n]+")


def visible(text: str) -> str:
    """`text` with every character that a terminal would obey instead of show as its escape, such as `\\x1b`.

    Line breaks and tabs are among them, so that a name cannot pass for another line.
    """
    return _spelled(text, lambda c: c.encode("unicode_escape", "surrogatepass").decode("ascii"))


def visible_lines(text: str) -> str:
    """`text` of several lines, each of them `visible`; line feeds and tabs stay."""
    return _WITHIN_LINES.sub(lambda line: visible(line[0]), text)


def visible_json(text: str) -> str:
    """A JSON document, in which JSON's own escapes stand for what `visible` would replace; line feeds stay."""
    return _WITHIN_LINES.sub(lambda line: _spelled(line[0], lambda c: json.dumps(c)[1:-1]), text)


def _spelled(text: str, spell: Callable[[str], str]) -> str:
    if text.isascii() and text.isprintable():
        return text
    return "".join(spell(c) if unicodedata.category(c) in _HIDDEN else c for c in text)


def json_text(value: Any, indent: int | None = None) -> str:
    """Returns a JSON document of a value, as `jsonable` and `visible_json` make it."""
    return visible_json(json.dumps(jsonable(value), indent=indent, ensure_ascii=False, allow_nan=False))


def jsonable(value: Any) -> Any:
    """JSON values only: numbers that JSON has no word for become the strings NaN, Infinity and -Infinity."""
    import numpy as np

    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value if value is None or isinstance(value, (str, bool, int, float)) else str(value)
