"""Envelopes: what is said on a stream, and what a decoder accepts of it."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from dataflow.messages.base import Message

MAGIC: Final = b"\x9cDFE"
VERSION: Final = 1
ALIGNMENT: Final = 64
PRELUDE: Final = struct.Struct("<4sBBHI")  # magic, version, kind, head bytes, body bytes

Buffer = bytes | bytearray | memoryview


class DecodeError(ValueError):
    """Bytes are no envelope; the message names the fault and its place."""


class Kind(IntEnum):
    """Kinds of statements that an envelope makes about its stream."""

    MESSAGE = 1
    """A message; `stamp` is the message's. It implies the frontier `stamp`."""
    FRONTIER = 2
    """No later message has a stamp ≤ `stamp`. `incarnation` and `seq` are the next message's."""
    END = 3
    """Nothing follows: `stamp` is the final one, `reason` the cause. `incarnation` and `seq` are those that the next
    message would have had."""
    PROBE = 5
    """Start barrier: carries no data. `seq` is the probe's number."""
    REFERENCE = 6
    """A message that lies in shared memory: resolved by the bus, never seen by its users."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a decoder. Anything larger is a `DecodeError` before memory is taken for it."""

    head_bytes: int = 4096
    body_bytes: int = 1 << 20
    payload_bytes: int = 1 << 30
    dimensions: int = 8
    string_bytes: int = 1 << 16
    strings: int = 1 << 16


DEFAULT_LIMITS: Final = Limits()


@dataclass(slots=True)
class Head:
    """Holds what every envelope has before its content: enough for rates, lag and routing."""

    kind: Kind
    stream: str
    incarnation: int
    seq: int
    stamp: int
    wall: int
    """Wall time of the publication, ns since the epoch. For showing lag only, never compared."""
    reason: str


@dataclass(slots=True)
class Envelope:
    """One thing that happens on a stream. It is never changed (it is not frozen: one is made for every message).

    `stamp` is the message's stamp, the frontier, or the final stamp (ns since the epoch), by `kind`. `wall` is the wall
    time of the publication (ns), for showing lag only.
    """

    kind: Kind
    stream: str
    incarnation: int
    seq: int
    stamp: int
    message: Message | None = None
    reason: str = ""
    wall: int = 0
