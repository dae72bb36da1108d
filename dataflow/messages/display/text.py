"""Messages for people: a field as a line of text, a message as HTML, for terminals and notebooks."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

SHOWN_ELEMENTS = 16
"""Arrays and lists up to this length are shown whole."""
_CELL = "text-align:left;font-family:monospace;white-space:pre-wrap"


def field_text(value: Any, *, whole: bool = False) -> str:
    """A field's value: six digits, long arrays by their shape and range, long lists by their beginning.

    `whole`: nothing is left out.
    """
    if isinstance(value, np.ndarray):
        if whole or value.size <= SHOWN_ELEMENTS:
            limit = value.size + 1 if whole else SHOWN_ELEMENTS
            text = np.array2string(value, precision=6, suppress_small=True, threshold=limit, separator=", ")
            return " ".join(text.split())
        shape = " × ".join(map(str, value.shape))
        return f"{value.dtype} {shape}{_range(value)}"
    if isinstance(value, tuple):
        shown = value if whole or len(value) <= SHOWN_ELEMENTS else value[:5]
        more = f", … {len(value)} in all" if len(shown) < len(value) else ""
        return ", ".join(map(str, shown)) + more if value else "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str):
        return value if whole or len(value) <= 200 else f"{value[:200]}… {len(value):,} characters in all"
    return str(value)


def _range(value: npt.NDArray[Any]) -> str:
    """The smallest and the largest finite element, in words."""
    if value.dtype.kind not in "iuf" or not value.size:
        return ""
    finite = value[np.isfinite(value)] if value.dtype.kind == "f" else value
    return f"  from {finite.min():.4g} to {finite.max():.4g}" if finite.size else "  nothing finite"


def message_html(schema: str, fields: Iterable[tuple[str, Any]], picture: tuple[str, bytes] | None) -> str:
    """A message as HTML: its picture (format, file), if it has one, and a table of its fields."""
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="{_CELL}">{escape(field_text(value))}</td></tr>'
        for name, value in fields
        if value is not None
    )
    shown = ""
    if picture is not None:
        kind, data = picture
        shown = f'<img src="data:image/{kind};base64,{base64.b64encode(data).decode()}" style="max-width:100%"/>'
    return f"<div><b>{escape(schema)}</b><br/>{shown}<table>{rows}</table></div>"
