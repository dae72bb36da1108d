"""Holds what a process inherits from the supervisor, by the order of the descriptors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dataflow.transport import Incoming, Outgoing, PoolReader

BACKLOG = (16, 8)
"""The number of windows of messages and of bytes that may wait for operators that no source waits for."""


@dataclass(frozen=True, slots=True)
class Descriptors:
    """The eventfd that wakes this process, its links to and from others, and the memory for its firing records."""

    wake: int
    outgoing: Sequence[tuple[Sequence[str], Outgoing]]
    incoming: Sequence[Incoming]
    box: int | None


def take_descriptors(descriptors: Sequence[int], config: Mapping[str, Any]) -> Descriptors:
    """Opens what was handed down.

    The order: this process's eventfd; ring, eventfd of the other process and board of each link of the configuration's
    `links_out`, then of its `links_in`; last, for an operator process of a live run, the memory for its firing records.
    """
    rest = iter(descriptors)
    wake = next(rest)
    window, factors = config.get("window", (256, 64 << 20)), BACKLOG
    bound = window[0] * factors[0], window[1] * factors[1]
    outgoing = [
        (keys, Outgoing(*_three(rest), bound if lossy else None)) for lossy, keys in config.get("links_out", ())
    ]
    pools = PoolReader()
    incoming = [Incoming(*_three(rest), keys, pools, config.get("life", 1)) for keys in config["links_in"]]
    return Descriptors(wake, outgoing, incoming, next(rest, None))


def _three(descriptors: Iterator[int]) -> tuple[int, int, int]:
    return next(descriptors), next(descriptors), next(descriptors)
