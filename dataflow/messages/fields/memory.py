"""Decides where the large arrays of messages lie: in memory of the process, or where others can read them in place."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

LARGE = 32 << 10
"""Bytes of the smallest array for which it matters."""

Room = Callable[[int], npt.NDArray[np.uint8] | None]
"""Gives memory for an array of so many bytes, or None where there is none; on any thread."""

_room: Room | None = None


def make_large_arrays_in(room: Room | None) -> None:
    """Allocates the large arrays of this process's messages in `room`; None: in private memory."""
    global _room
    _room = room


def copied(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Returns a C-contiguous copy of an array."""
    if _room is not None and array.nbytes >= LARGE:
        room = _room(array.nbytes)
        if room is not None:
            made: npt.NDArray[Any] = np.ndarray(array.shape, array.dtype, room)
            made[...] = array
            return made
    return array.copy()


os.register_at_fork(after_in_child=lambda: make_large_arrays_in(None))  # the memory is its parent's to give
