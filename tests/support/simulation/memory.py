"""Shared memory on a simulated machine: it is real, but whoever writes to it may give way, or be killed, before and
after."""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.records.black_box import BlackBox
from dataflow.records.firing import FiringRecord
from dataflow.transport.ring import Bytes, RingWriter
from simulation.world import World


def ring_writer(world: World) -> type[RingWriter]:
    """The writing end of a ring, in this world."""

    class Writer(RingWriter):
        def put(self, channel: int, parts: Sequence[Bytes]) -> bool:
            world.effect()
            return super().put(channel, parts)

    return Writer


def black_box(world: World) -> type[BlackBox]:
    """The memory for firing records, in this world."""

    class Box(BlackBox):
        def add(self, record: FiringRecord) -> None:
            world.effect()
            super().add(record)
            world.effect()

    return Box
