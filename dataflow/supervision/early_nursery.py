"""A nursery that is started before the graph is read: both take a while, and a machine has more than one core."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from dataflow.execution.threads import THREADS, environment
from dataflow.supervision.nursery import Nursery, NurseryFailed


class EarlyNursery:
    """Holds a nursery until the run that it was started for is known, and fits it."""

    def __init__(self) -> None:
        self._nursery: Nursery | None = None
        with contextlib.suppress(OSError):  # the run will try again, and say why it cannot
            self._nursery = Nursery(environment(1))

    def take(self, threads: int) -> Nursery | None:
        """Returns the nursery for processes of so many threads each; None where it was started for others."""
        wanted = environment(threads)
        if self._nursery is None or any(self._nursery.environment[name] != wanted[name] for name in THREADS):
            return None
        nursery, self._nursery = self._nursery, None
        try:
            nursery.give(wanted)
        except NurseryFailed:  # it has died since
            nursery.close()
            return None
        return nursery

    def close(self) -> None:
        """Ends the nursery if it has not been taken."""
        if self._nursery is not None:
            self._nursery.close()
            self._nursery = None


@contextlib.contextmanager
def early_nursery() -> Iterator[EarlyNursery]:
    """Starts a nursery for a graph whose operators are given one thread each, the default."""
    early = EarlyNursery()
    try:
        yield early
    finally:
        early.close()
