"""Text that somebody else wrote, made fit for a terminal."""

from __future__ import annotations

import unicodedata

_HIDDEN = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))
"""Unicode categories: control, format (such as a change of direction), surrogate, line and paragraph separator."""


def visible(text: str) -> str:
    """`text` with every character that a terminal would obey instead of show as its escape, such as `\\x1b`.

    Line breaks and tabs are among them, so that a name cannot pass for a line of its own.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escaped(c) if unicodedata.category(c) in _HIDDEN else c for c in text)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")
