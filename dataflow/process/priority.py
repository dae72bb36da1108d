"""The priority of a process whose work can wait beside those that a live run waits for."""

from __future__ import annotations

import ctypes
import os
import platform
import struct

NICE = 1
"""Weighs 0.8 of an operator's process where cores are short: it falls behind no further than its windows allow."""
SLICE_NS = 20_000_000
"""An operator's process has 1 to 3 ms. Of two processes with different slices, the one with the shorter goes first when
it is woken (Linux 6.12 and later; before, it changes nothing)."""
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
"""Numbers of the system call: the C library has a name for it only since glibc 2.41."""
_ATTRIBUTES = struct.Struct("=IIQiIQQQII")
"""`struct sched_attr`: size, policy, flags, nice, priority, runtime (the slice), deadline, period, two clamps."""


def let_others_begin() -> bool:
    """Lets processes that are woken take the core of the calling thread, which has the less urgent work; False where
    the system does not allow that.

    With `SCHED_BATCH` alone, or a nice value alone, a process that was woken on this core still waits for the next tick
    of the kernel, up to 4 ms: for a message that one message away was on its way in 50 µs.
    """
    number = _SCHED_SETATTR.get(platform.machine())
    if number is None or not hasattr(os, "SCHED_BATCH"):
        return False
    nice = min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICE)
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_BATCH, 0, nice, 0, SLICE_NS, 0, 0, 0, 0)
    return bool(ctypes.CDLL(None).syscall(number, 0, attributes, 0) == 0)
