"""Measures work: the CPU time of calls, with their wall time beside it.

Wall time holds whatever a call waits for: a device, a lock, a GPU, other processes on a busy machine. CPU time is that
of the calling thread alone; threads that a library starts are not in it.
"""

from __future__ import annotations

import time


class Work:
    """Adds up the time spent in `with` blocks (ns). Blocks of one `Work` do not nest, and belong to one thread."""

    __slots__ = ("_cpu", "_wall", "cpu_ns", "wall_ns")

    def __init__(self) -> None:
        self.cpu_ns = self.wall_ns = 0
        self._cpu = self._wall = 0

    def __enter__(self) -> None:
        self._wall, self._cpu = time.perf_counter_ns(), time.thread_time_ns()

    def __exit__(self, *_: object) -> None:
        self.cpu_ns += time.thread_time_ns() - self._cpu
        self.wall_ns += time.perf_counter_ns() - self._wall
