"""Ends a process with its parent, however that dies: by the kernel, on Linux alone."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None) if sys.platform.startswith("linux") else None
"""Loaded before a fork: in a child of a process with threads, loading may wait for one that is not there."""


def end_with_parent(number: int = signal.SIGKILL, parent: int | None = None) -> None:
    """Has the kernel send a signal to this process when the thread that started it ends; nothing outside of Linux.

    `parent`: the id of the process that started this one, which gets the signal now if that has ended before.
    """
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, int(number))
        if parent is not None and os.getppid() != parent:
            os.kill(os.getpid(), number)
