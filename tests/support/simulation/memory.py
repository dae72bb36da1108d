"""Shared memory on a simulated machine: it is real, but whoever writes to it may give way, or be killed, before and
after."""

from __future__ import annotations

from dataflow.records.black_box import BlackBox
from dataflow.records.firing import FiringRecord
from simulation.world import World


def black_box(world: World) -> type[BlackBox]:
    """The memory for firing records, in this world."""

    class Box(BlackBox):
        def add(self, record: FiringRecord) -> None:
            world.effect()
            super().add(record)
            world.effect()

    return Box
