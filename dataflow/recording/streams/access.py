"""Random access to the messages of one stream of a recording, and their fields as columns."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.recording.streams.entries import Recorded
from dataflow.recording.streams.json_columns import Values
from dataflow.recording.streams.ordering import Row

BATCH = 128
"""Messages that are decoded together; what they hold besides the fields asked for is in memory meanwhile."""
_WIDTH = 8
_KEY, _LOG_TIME = 0, 4


class StreamIndex:
    """The messages of one stream by their place in it, from 0; 64 bytes of memory a message until one is read.

    `stamps`: (N,) nanoseconds since the epoch, in stream order.
    """

    def __init__(
        self,
        rows: Iterable[Row],
        read: Callable[[Row], Recorded],
        columns: Callable[[Sequence[Row], Collection[str]], Mapping[str, Values]],
        *,
        stamped_by_log_time: bool,
    ) -> None:
        self._rows = np.fromiter(itertools.chain.from_iterable(rows), np.int64).reshape(-1, _WIDTH)
        self._read, self._columns = read, columns
        self.stamps: npt.NDArray[np.int64] = self._rows[:, _LOG_TIME if stamped_by_log_time else _KEY]

    def __len__(self) -> int:
        return len(self._rows)

    def read(self, place: int) -> Recorded:
        """The message at a place, decoded now. Raises `RecordingError`."""
        return self._read(tuple(self._rows[place].tolist()))

    def columns(self, places: npt.NDArray[np.int64], names: Collection[str]) -> dict[str, Values]:
        """The named fields of the messages at `places`: by name their values, None where a message has none.

        Where all are arrays of one shape they may come stacked. Cheaper than the messages, which check their fields
        together. Raises `RecordingError`.
        """
        parts: dict[str, list[Values]] = {name: [] for name in names}
        for first in range(0, len(places), BATCH):
            rows = [tuple(row) for row in self._rows[places[first : first + BATCH]].tolist()]
            for name, values in self._columns(rows, names).items():
                parts[name].append(values)
        return {name: _joined(found) for name, found in parts.items()}


def _joined(parts: Sequence[Values]) -> Values:
    shapes = {part.shape[1:] if isinstance(part, np.ndarray) else None for part in parts}
    if len(shapes) == 1 and None not in shapes:
        return np.concatenate([part for part in parts if isinstance(part, np.ndarray)])
    whole: list[Any] = []
    for part in parts:
        whole.extend(part)
    return whole
