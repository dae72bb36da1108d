"""Freed memory, kept for the next chunk of a recording."""

from __future__ import annotations

import ctypes
import os

KEPT, LARGEST = 2**26, 2**25
"""Bytes that stay with the process when they are freed, and the largest block of them: as large as glibc allows."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3


def keep_freed_memory() -> bool:
    """Lets this process keep what it frees (glibc's mallopt(3)); False where the C library has no such setting.

    A recorder makes and frees chunks of 4 MiB all the time: otherwise the kernel has to find and to clear their pages
    anew, which takes a fifth of its CPU time. Settings of the user's environment count.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    for option, name, value in (
        (_TRIM_THRESHOLD, "MALLOC_TRIM_THRESHOLD_", KEPT),
        (_MMAP_THRESHOLD, "MALLOC_MMAP_THRESHOLD_", LARGEST),
    ):
        if name not in os.environ:
            mallopt(option, value)
    return True
