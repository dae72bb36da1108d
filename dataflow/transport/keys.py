"""The runtime's own Zenoh keys. They live behind the verbatim chunk `@`, which no wildcard matches.

A stream's key is its name, `<namespace>/<operator>/<port>`; a namespace may have several chunks.
"""

from __future__ import annotations

RUNTIME = "@"


def split_stream(stream: str) -> tuple[str, str, str]:
    """(namespace, operator, port) of a stream name; raises `ValueError` when it has fewer than three chunks."""
    chunks = stream.rsplit("/", 2)
    if len(chunks) != 3 or not all(chunks):
        raise ValueError(f"stream {stream!r}: expected <namespace>/<operator>/<port>")
    return chunks[0], chunks[1], chunks[2]


def runtime_key(namespace: str, *chunks: str) -> str:
    """`<namespace>/@/<chunks>`."""
    return "/".join((namespace, RUNTIME, *chunks))


def static_key(stream: str) -> str:
    """Where the static stream `stream` is answered to late joiners."""
    namespace, operator, port = split_stream(stream)
    return runtime_key(namespace, "static", operator, port)


def shared_key(stream: str, machine: str, pid: str, descriptor: str, bus: str) -> str:
    """The liveliness token of a consumer of `stream` that can read shared memory."""
    namespace, operator, port = split_stream(stream)
    return runtime_key(namespace, "shm", operator, port, machine, pid, descriptor, bus)


def alive_key(namespace: str, operator: str) -> str:
    """The liveliness token of an operator."""
    return runtime_key(namespace, "alive", operator)


def stream_of(key: str) -> str:
    """The stream that a runtime key `<namespace>/@/<word>/.../<operator>/<port>` is about."""
    namespace, _, rest = key.partition(f"/{RUNTIME}/")
    operator, _, port = rest.rpartition("/")
    return f"{namespace}/{operator.rpartition('/')[2]}/{port}"
