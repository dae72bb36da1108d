"""The runtime's own Zenoh keys. They live behind the verbatim chunk `@`, which no wildcard matches.

A stream's key is its name, `<namespace>/<operator>/<port>`; a namespace may have several chunks, and so may the name of
an operator of a nested graph. What concerns one stream lies below its own key.
"""

from __future__ import annotations

RUNTIME = "@"
HERE = "@here"
"""The chunk of keys that tools of other machines are not let to."""


def runtime_key(namespace: str, *chunks: str) -> str:
    """`<namespace>/@/<chunks>`."""
    return "/".join((namespace, RUNTIME, *chunks))


def local_key(namespace: str, *chunks: str) -> str:
    """`<namespace>/@here/<chunks>`: a runtime key for tools of this machine alone."""
    return "/".join((namespace, HERE, *chunks))


def static_key(stream: str) -> str:
    """Returns where the static stream `stream` (or those that match an expression) is answered to late joiners."""
    return f"{stream}/{RUNTIME}/static"


def stream_of_static(key: str) -> str:
    """The stream that a `static_key` is about."""
    return key.removesuffix(f"/{RUNTIME}/static")


def statics_key(namespace: str, bus: str) -> str:
    """Returns where a process answers which static streams it holds; `*` for all processes."""
    return runtime_key(namespace, "statics", bus)


def tap_key(namespace: str, tap: str, stream: str) -> str:
    """Returns where the copies of `stream` for one tap travel."""
    return runtime_key(namespace, "tap", tap, stream.removeprefix(f"{namespace}/"))


def stream_of_tap(namespace: str, tap: str, key: str) -> str:
    """The stream that a `tap_key` is about."""
    return f"{namespace}/{key.removeprefix(runtime_key(namespace, 'tap', tap) + '/')}"
