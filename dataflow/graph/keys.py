"""Names and Zenoh key expressions: which are well formed, and which streams an expression matches."""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterable, Sequence

_NAME = re.compile(r"[^\W\d][\w-]*")
_REPEATED = re.compile(r"(\$\*){2,}")
_BARE_STAR = re.compile(r"(?<!\$)\*")
_WITHIN = re.compile(r"\$\*|.", re.DOTALL)


def name_fault(name: str) -> str | None:
    """Returns why `name` cannot name an operator, a graph or one part of a namespace; None when it can."""
    if _NAME.fullmatch(name):
        return None
    bad = next((c for c in name if not re.match(r"[\w-]", c)), None)
    if bad is not None:
        return f"{name!r} contains {'a space' if bad == ' ' else repr(bad)}"
    return f"{name!r} begins with {name[0]!r}" if name else "it is empty"


NAME_RULE = "a name is letters, digits, '_' and '-', and begins with a letter or '_'"


def key_fault(key: str) -> str | None:
    """Returns why a key expression (without a leading '/') is not one, in our own words; None when it is."""
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
    """Returns the canonical spelling of a key expression that has no fault (`**/*` becomes `*/**`)."""
    chunks: list[str] = []
    for chunk in key.split("/"):
        chunk = _REPEATED.sub("$*", chunk)
        chunk = "*" if chunk == "$*" else chunk
        if chunks[-1:] != ["**"]:
            chunks.append(chunk)
        elif chunk == "*":
            chunks.insert(-1, chunk)
        elif chunk != "**":
            chunks.append(chunk)
    return "/".join(chunks)


def as_expression(pattern: str) -> str:
    """Returns the key expression for a pattern as people write it: the `*` of `image*`, too, is any characters."""
    return "/".join(c if c in ("*", "**") else _BARE_STAR.sub("$*", c) for c in pattern.split("/"))


def has_wildcard(key: str) -> bool:
    return "*" in key


def matching(key: str, names: Iterable[str]) -> list[str]:
    """Returns those of `names` (plain keys) that the canonical expression `key` matches, sorted."""
    if not has_wildcard(key):
        return [name for name in names if name == key][:1]
    return sorted(name for name in names if intersect(key, name))


def may_reach(key: str, prefix: str) -> bool:
    """Returns whether the expression could match something below `prefix`."""
    return intersect(key, f"{prefix}/**")


@functools.lru_cache(maxsize=4096)
def intersect(left: str, right: str) -> bool:
    """Returns whether some key matches both expressions, as Zenoh decides it.

    A part `**` stands for any number of parts, `*` for one, `$*` for any characters within a part. None of them matches
    a part that begins with `@`.
    """
    return _meet(left.split("/"), right.split("/"), "**", _chunks_meet, lambda chunk: not chunk.startswith("@"))


def _chunks_meet(left: str, right: str) -> bool:
    if left == right:
        return True
    if left.startswith("@") or right.startswith("@"):
        return False
    if "*" in (left, right):
        return True
    return _meet(_WITHIN.findall(left), _WITHIN.findall(right), "$*", str.__eq__, lambda _: True)


def _meet(
    left: Sequence[str],
    right: Sequence[str],
    many: str,
    meet: Callable[[str, str], bool],
    passes: Callable[[str], bool],
) -> bool:
    """Returns whether two patterns have a word in common; `many` stands for any number of elements that pass."""
    # able[j]: the elements of `left` so far and the first j of `right` have a word in common
    able = [True, *itertools.accumulate((r == many for r in right), lambda a, b: a and b)]
    for element in left:
        if element == many:
            after = [able[0]]
            for j, r in enumerate(right, start=1):
                after.append(able[j] or ((r == many or passes(r)) and after[j - 1]))
        else:
            after = [False]
            for j, r in enumerate(right, start=1):
                if r == many:
                    after.append(after[j - 1] or (passes(element) and able[j]))
                else:
                    after.append(able[j - 1] and meet(element, r))
        able = after
    return able[-1]
