"""Random access to the messages of one stream of a recording."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from dataflow.recording.ordering import Row

T = TypeVar("T")
_WIDTH = 8
_KEY, _LOG_TIME = 0, 4


class StreamIndex(Generic[T]):
    """The messages of one stream by their place in it, from 0; 64 bytes of memory a message until one is read.

    `stamps`: (N,) nanoseconds since the epoch, in stream order.
    """

    def __init__(
        self,
        rows: Iterable[Row],
        read: Callable[[Row], T],
        fields: Callable[[Row, Collection[str]], Mapping[str, Any]],
        *,
        stamped_by_log_time: bool,
    ) -> None:
        self._rows = np.fromiter(itertools.chain.from_iterable(rows), np.int64).reshape(-1, _WIDTH)
        self._read, self._fields = read, fields
        self.stamps: npt.NDArray[np.int64] = self._rows[:, _LOG_TIME if stamped_by_log_time else _KEY]

    def __len__(self) -> int:
        return len(self._rows)

    def read(self, place: int) -> T:
        """The message at a place, decoded now. Raises `RecordingError`."""
        return self._read(tuple(self._rows[place].tolist()))

    def fields(self, place: int, names: Collection[str]) -> Mapping[str, Any]:
        """The named fields of the message at a place, those that are None left out. Raises `RecordingError`."""
        return self._fields(tuple(self._rows[place].tolist()), names)
