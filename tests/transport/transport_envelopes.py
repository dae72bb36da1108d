"""Envelopes for the transport tests."""

from __future__ import annotations

from dataflow.messages.base import Message
from dataflow.transport import Envelope, Kind


def carrying(message: Message, stream: str, seq: int, incarnation: int = 0, wall: int = 0) -> Envelope:
    """The envelope that carries `message`."""
    return Envelope(Kind.MESSAGE, stream, incarnation, seq, message.stamp, message, wall=wall)
