"""Measures work: the CPU time of calls, with their wall time beside it.

Wall time holds whatever a call waits for: a device, a lock, a GPU, other processes on a busy machine. CPU time is that
of the calling thread alone; threads that a library starts are not in it.
"""

from __future__ import annotations

import time

SETTLES_IN = 8
"""Calls over which the mean follows a change."""
AT_FIRST = 10_000_000
SHORT = 50_000
"""ns: of calls that take less on average, the CPU clock is asked now and then; it costs as much as a small firing."""
EXACT_EVERY = 64
PREEMPTED = 1_000_000
"""ns: a short call that took longer has waited for something, or was no short one."""


class Work:
    """Adds up the time (ns) between `begin` and `end`, or spent in `with` blocks. Of one `Work` these do not nest, and
    belong to one thread."""

    __slots__ = ("_calls", "_cpu", "_exact", "_wall", "cpu_ns", "mean_ns", "wall_ns")

    def __init__(self) -> None:
        self.cpu_ns = self.wall_ns = 0
        self.mean_ns = AT_FIRST
        """Average duration (ns, wall time) of the last calls; long before there was any."""
        self._cpu = self._wall = self._calls = 0
        self._exact = True

    def begin(self) -> int:
        """Begins to measure; returns the time on the monotonic clock, ns."""
        self._calls += 1
        self._exact = self.mean_ns >= SHORT or not self._calls % EXACT_EVERY
        self._wall = now = time.monotonic_ns()
        if self._exact:  # within what the wall clock measures, so that it is never more
            self._cpu = time.thread_time_ns()
        return now

    def end(self) -> None:
        """Adds up what `begin` has begun. A short call that was not preempted has taken as much CPU time as wall time;
        one that may have been, at most what the thread has taken since its CPU clock was last asked."""
        if self._exact:
            self.cpu_ns += time.thread_time_ns() - self._cpu
            wall = time.monotonic_ns() - self._wall
        elif (wall := time.monotonic_ns() - self._wall) < PREEMPTED:
            self.cpu_ns += wall
        else:
            now = time.thread_time_ns()
            self.cpu_ns += min(wall, now - self._cpu)
            self._cpu = now
        self.wall_ns += wall
        self.mean_ns += (wall - self.mean_ns) // SETTLES_IN

    def __enter__(self) -> None:
        self.begin()

    def __exit__(self, *_: object) -> None:
        self.end()
