"""Envelopes, and who takes them, for the transport tests."""

from __future__ import annotations

import numpy as np

from dataflow.messages import DepthImage
from dataflow.messages.base import Message
from dataflow.transport import Envelope, Kind
from dataflow.transport.pool import Block


def carrying(message: Message, stream: str, seq: int, incarnation: int = 0, wall: int = 0) -> Envelope:
    """The envelope that carries `message`."""
    return Envelope(Kind.MESSAGE, stream, incarnation, seq, message.stamp, message, wall=wall)


class Holder:
    """A consumer of a pool that releases what it is told to."""

    def __init__(self) -> None:
        self.done: set[int] = set()

    def released(self, slot: int, generation: int) -> bool:
        return generation in self.done

    def mapped(self, base: int) -> bool:
        return True

    def release(self, block: Block) -> None:
        self.done.add(block.generation)


def depth_image(stamp: int, side: int = 4) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=np.full((side, side), stamp, np.float32))
