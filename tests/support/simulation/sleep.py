"""The promise that no process sleeps while one of its operators could fire."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from dataflow.execution.driver import Ready
from simulation.world import Violation, World


@contextlib.contextmanager
def watched(world: World) -> Iterator[None]:
    """Whenever a process has asked all its operators in vain, each that is not awake must lack something."""
    right = Ready.step

    def step(self: Ready) -> bool:
        worked = right(self)
        if not worked:
            for runner in self._runners:
                stamp, needs = runner.waiting()
                due = runner.next_due()
                if stamp is not None and not needs and due is None and not (runner.awake or runner.ended):
                    world.violation = Violation(f"{runner.node.name} sleeps though its firing at {stamp} is decided")
        return worked

    Ready.step = step  # type: ignore[method-assign]
    try:
        yield
    finally:
        Ready.step = right  # type: ignore[method-assign]
