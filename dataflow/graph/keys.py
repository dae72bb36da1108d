"""Names and Zenoh key expressions: which are well formed, and which streams an expression matches."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable

import zenoh

_NAME = re.compile(r"[^\W\d][\w-]*")


def name_fault(name: str) -> str | None:
    """Why `name` cannot name an operator, a graph or one part of a namespace; None when it can."""
    if _NAME.fullmatch(name):
        return None
    bad = next((c for c in name if not re.match(r"[\w-]", c)), None)
    if bad is not None:
        return f"{name!r} contains {'a space' if bad == ' ' else repr(bad)}"
    return f"{name!r} begins with {name[0]!r}" if name else "it is empty"


NAME_RULE = "a name is letters, digits, '_' and '-', and begins with a letter or '_'"


def key_fault(key: str) -> str | None:
    """Why a key expression (without a leading '/') is not one, in our own words; None when it is."""
    if not key:
        return "it is empty"
    if key.startswith("/") or key.endswith("/") or "//" in key:
        return "it has an empty part: no '/' at its end and no '//'"
    for chunk in key.split("/"):
        if bad := next((c for c in chunk if c in "#?" or c.isspace()), None):
            return f"{chunk!r} contains {bad!r}, which no key may"
        if chunk.startswith("@"):
            return f"{chunk!r}: parts that begin with '@' are the runtime's own"
        rest = chunk.replace("$*", "")
        if chunk not in ("*", "**") and ("*" in rest or "$" in rest):
            return f"in {chunk!r}: a '*' inside a part is written '$*' (and '*' or '**' alone is a whole part)"
    return None


def canonical(key: str) -> str:
    """The canonical spelling of a key expression that has no fault (`**/*` becomes `*/**`)."""
    return str(zenoh.KeyExpr.autocanonize(key))


def has_wildcard(key: str) -> bool:
    return "*" in key


def matching(key: str, names: Iterable[str]) -> list[str]:
    """Those of `names` (plain keys) that the canonical expression `key` matches, sorted."""
    if not has_wildcard(key):
        return [name for name in names if name == key][:1]
    pattern = _expression(key)
    return sorted(name for name in names if pattern.intersects(_expression(name)))


def may_reach(key: str, prefix: str) -> bool:
    """True when the expression could match something below `prefix`."""
    return bool(_expression(key).intersects(_expression(f"{prefix}/**")))


@functools.lru_cache(maxsize=4096)
def _expression(key: str) -> zenoh.KeyExpr:
    return zenoh.KeyExpr(key)
