"""Entries of a recording as a reader gives them: messages decoded and as they stand in the file, and events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dataflow.messages.base import Message


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording and its place in its stream."""

    stream: str
    message: Message
    seq: int
    incarnation: int

    @property
    def stamp(self) -> int:
        """The timestamp of the message, nanoseconds since the epoch."""
        return self.message.stamp


@dataclass(frozen=True, slots=True)
class RawRecord:
    """One message as it stands in the file, decoded or not."""

    stream: str
    schema: str
    encoding: str
    log_time: int
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to the run."""

    name: str
    stamp: int
    data: Mapping[str, Any]
