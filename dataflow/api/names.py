"""Finds the streams that a short name or a pattern means."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.graph.keys import as_expression, canonical, has_wildcard, key_fault, matching
from dataflow.graph.problems import did_you_mean


class StreamNameError(KeyError):
    """A name matches no stream, or several where one is wanted; the message lists the candidates."""

    def __str__(self) -> str:
        return str(self.args[0])


def streams_named(word: str, names: Iterable[str], namespace: str = "") -> list[str]:
    """The streams that `word` means, in the order of `names`.

    It is a full name, a name without the namespace, the last parts of a name (`imu` for `robot1/robot/imu`), or a key
    expression with wildcards (`robot/*`, `**/image`, `image*`). Raises `StreamNameError` where there is none.
    """
    known = list(names)
    keys = {name.strip("/"): name for name in known}  # foreign recordings name streams "/tf"
    bare = as_expression(word.strip("/"))
    if (fault := key_fault(bare)) is not None:
        raise StreamNameError(f"stream {word!r}: {fault}")
    for expression in _readings(bare, namespace):
        if found := {keys[key] for key in matching(canonical(expression), keys)}:
            return [name for name in known if name in found]
    shown = [name.removeprefix(f"{namespace}/") if namespace else name for name in known]
    raise StreamNameError(f"no stream {word!r}: " + did_you_mean(word, shown, "there are"))


def stream_named(word: str, names: Iterable[str], namespace: str = "") -> str:
    """The one stream that `word` means. Raises `StreamNameError` also where it means several."""
    found = streams_named(word, names, namespace)
    if len(found) > 1:
        raise StreamNameError(f"{word!r} means {len(found)} streams: {', '.join(found)}; select() takes several")
    return found[0]


def _readings(word: str, namespace: str) -> Iterable[str]:
    """Yields what a word may mean, the likeliest first."""
    yield word
    if namespace:
        yield f"{namespace}/{word}"
    if not has_wildcard(word):
        yield f"**/{word}"
