"""Inputs and outputs of an aligner: entries, firings and drops.

They are never changed. Those that are made for every message are not frozen all the same: it would make them cost three
times as much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

FiringKind = Literal["fire", "tick", "finish"]
DropReason = Literal["unmatched", "no_sample", "stale", "unused", "late", "overflow", "reset", "refused"]
MISSES = frozenset({"unmatched", "unused", "no_sample"})
"""Reasons that are no loss: no firing needed the message, or there was nothing to join or to sample it with."""

TICK = "@tick"
"""The input named by the drop of a tick, which belongs to no declared input."""


class StreamOrderError(ValueError):
    """A stream broke its own promise: a stamp that does not increase, one at or below its frontier, one that lies at
    the end of time, or a message of an earlier incarnation. Whatever said so has changed nothing: it can be dropped.
    """

    def __init__(self, stream: str, problem: str) -> None:
        super().__init__(f"stream {stream!r}: {problem}")
        self.stream, self.problem = stream, problem


@dataclass(slots=True, unsafe_hash=True)
class Entry:
    """A message as the aligner sees it. Its identity is (stream, incarnation, seq); `value` is only carried.

    stamp: event time, ns. seq: gapless within an incarnation of the stream. digest: of the message's content.
    """

    stamp: int
    value: Any = field(compare=False, repr=False, default=None)
    seq: int = 0
    incarnation: int = 0
    digest: bytes = b""
    stream: str = ""


InputValue = Entry | None | tuple[Entry, ...] | Mapping[str, Entry]
"""An entry or None; of a Batch a tuple; of a `many` trigger or Sampled a map from stream to entry."""


def entries_of(given: InputValue) -> Sequence[Entry]:
    """All entries an input was given, in the order `process()` sees them."""
    match given:
        case None:
            return ()
        case Entry():
            return (given,)
        case Mapping():
            return tuple(given.values())
        case _:
            return given


@dataclass(slots=True)
class Firing:
    """One call of `process()` (or of `finish()`): a stamp plus the exact messages given to each input.

    kind: "fire" for trigger messages, "tick" for a tick alone, "finish" for the last one, without inputs.
    tick: whether a tick lies at this stamp.
    stale: the Sampled inputs from which a message was withheld as older than `max_age`.
    late: the Sampled and Batch inputs holding a message that an earlier firing should have had.
    """

    stamp: int
    kind: FiringKind
    tick: bool = False
    inputs: Mapping[str, InputValue] = field(default_factory=dict)
    stale: frozenset[str] = frozenset()
    late: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Drop:
    """A message (or tick, whose input is `TICK`) that no firing took.

    unmatched: a join found no partner.
    no_sample, stale: the required Sampled input `because` had no message yet, or too old a one.
    unused: a Batch message cut off by `max` or `max_age`, or after the last firing.
    late: it came after a forced decision, or on a restarted stream that went back over its stamps.
    overflow: the queue in front of a trigger was full, or ticks were left out.
    reset: it waited when the clock behind an input jumped back, or came from before that.
    refused: its stream had promised that there would be no such message.
    """

    input: str
    stream: str
    stamp: int
    seq: int
    incarnation: int
    reason: DropReason
    because: str = ""


@dataclass(frozen=True, slots=True)
class Waiting:
    """The first undecided stamp, and the frontier that each input which holds it up would have to reach.

    `FOREVER` stands for a static stream whose message is missing: no forced frontier takes its place.
    """

    stamp: int
    needs: Mapping[str, int]
