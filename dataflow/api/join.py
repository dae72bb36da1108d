"""Messages of several streams, matched by their timestamps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dataflow.api.asof import NONE
from dataflow.api.columns import Column
from dataflow.api.frames import frame
from dataflow.api.stream import RecordedStream
from dataflow.messages.base import Message

if TYPE_CHECKING:
    import pandas as pd


class Joined(Sequence[tuple[Message | None, ...]]):
    """A row for each message of the first stream: that message, and its match in each other stream, or None."""

    def __init__(self, streams: Sequence[RecordedStream], places: Sequence[npt.NDArray[np.int64]]) -> None:
        self.streams = tuple(streams)
        self.places = (np.arange(len(streams[0]), dtype=np.int64), *places)
        """By stream, (N,) the place of each row's message in it; -1 where there is none."""

    def __len__(self) -> int:
        return len(self.places[0])

    def __getitem__(self, row: int) -> tuple[Message | None, ...]:  # type: ignore[override]
        if not -len(self) <= row < len(self):
            raise IndexError(f"row {row} of {len(self)}")
        return tuple(
            None if places[row] == NONE else stream[int(places[row])]
            for stream, places in zip(self.streams, self.places, strict=True)
        )

    def __iter__(self) -> Iterator[tuple[Message | None, ...]]:
        return (self[row] for row in range(len(self)))

    def complete(self) -> Joined:
        """The rows in which every stream has a message."""
        whole = np.logical_and.reduce([places != NONE for places in self.places])
        made = Joined(self.streams, [places[whole] for places in self.places[1:]])
        made.places = tuple(places[whole] for places in self.places)
        return made

    def offsets(self) -> dict[str, npt.NDArray[np.float64]]:
        """By other stream, (N,) seconds from each row's first message to its match; NaN where there is none."""
        anchor = self.streams[0].stamps[self.places[0]]
        found = {}
        for stream, places in zip(self.streams[1:], self.places[1:], strict=True):
            if not len(stream):
                found[stream.name] = np.full(len(self), np.nan)
                continue
            away = (stream.stamps[places] - anchor) * 1e-9
            found[stream.name] = np.where(places == NONE, np.nan, away)
        return found

    def frame(self) -> pd.DataFrame:
        """A pandas table with a row for each match; columns are named `<stream>.<field>` by the last part of the
        stream's name, or its whole name where two are alike. Raises `ImportError` without pandas."""
        columns: dict[str, Column] = {}
        for name, stream, places in zip(self._labels(), self.streams, self.places, strict=True):
            columns[f"{name}.stamp"] = _taken(stream.stamps, places)
            columns |= {f"{name}.{field}": _taken(data, places) for field, data in stream.columns().items()}
        anchor = self.places[0]
        return frame(self.streams[0].stamps[anchor], self.streams[0].seconds[anchor], columns, asked=False)

    def _labels(self) -> list[str]:
        short = [stream.name.rpartition("/")[2] for stream in self.streams]
        return [
            name if short.count(name) == 1 else stream.name for name, stream in zip(short, self.streams, strict=True)
        ]

    def __repr__(self) -> str:
        return f"<join of {', '.join(stream.name for stream in self.streams)}: {len(self):,} rows>"


def _taken(data: Column, places: npt.NDArray[np.int64]) -> Column:
    """The rows of a column at `places`; where there is none, NaN in floating-point columns, else None."""
    absent = places == NONE
    if not absent.any():
        return data[places]
    kind = data.dtype if data.dtype.kind == "f" else np.dtype(object)
    found = np.empty((len(places), *data.shape[1:]), kind)
    found[~absent] = data[places[~absent]]
    found[absent] = np.nan if kind.kind == "f" else None
    return found
