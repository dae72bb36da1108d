"""The chunk index records of a summary, as columns: ten million of them are read in seconds.

Layout: https://mcap.dev/spec (chunk index, op=0x08).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.recording.chunks import Column
from dataflow.recording.rawfile import RECORD, RawFile

_HEAD = np.dtype(
    [("record", "V9"), ("first", "<i8"), ("last", "<i8"), ("start", "<i8"), ("length", "<i8"), ("table", "<u4")]
)
_PLACE = np.dtype([("channel", "<u2"), ("offset", "<i8")])
_MIDDLE = np.dtype([("index_length", "<i8"), ("name", "<u4")])
_SIZES = np.dtype([("packed", "<i8"), ("size", "<i8")])
_LEAST = _HEAD.itemsize + _MIDDLE.itemsize + _SIZES.itemsize
_UNBOUNDED = np.iinfo(np.int64)


@dataclass(frozen=True, slots=True)
class ChunkIndexes:
    """Chunk indexes in the order of their chunks. Times in ns.

    `starts`: of the chunk's record in the file; `lengths`: of it; `index_lengths`: of the message indexes behind it;
    `sizes`: uncompressed. Chunk `k` holds messages of `channels[rows[k] : rows[k + 1]]`, from `firsts[k]` to
    `lasts[k]`.
    """

    starts: Column
    lengths: Column
    sizes: Column
    index_lengths: npt.NDArray[np.uint32]
    firsts: Column
    lasts: Column
    channels: npt.NDArray[np.uint16]
    rows: Column

    def __len__(self) -> int:
        return len(self.starts)

    def channels_of(self, number: int) -> list[int]:
        """The channels of a chunk's messages."""
        found: list[int] = self.channels[self.rows[number] : self.rows[number + 1]].tolist()
        return found

    def holding(self, channels: npt.ArrayLike, start: int | None = None, end: int | None = None) -> Column:
        """The numbers of the chunks with messages of some channels, in a span of log times that may have any."""
        wanted = np.zeros(2**16, bool)
        wanted[np.asarray(channels, np.int64)] = True
        if start is None and end is None:
            return np.flatnonzero(np.logical_or.reduceat(wanted[self.channels], self.rows[:-1]))
        within = self.lasts >= (_UNBOUNDED.min if start is None else start)
        within &= self.firsts <= (_UNBOUNDED.max if end is None else end)
        numbers = np.flatnonzero(within)
        places, rows = _spread(self.rows, numbers)
        return numbers[np.logical_or.reduceat(wanted[self.channels[places]], rows[:-1])] if len(numbers) else numbers


def _spread(rows: Column, numbers: Column) -> tuple[Column, Column]:
    """Returns the places in `channels` of some chunks, and what `rows` is for these alone."""
    counts = rows[numbers + 1] - rows[numbers]
    own = np.concatenate([[0], np.cumsum(counts)])
    return np.repeat(rows[numbers] - own[:-1], counts) + np.arange(own[-1]), own


class ChunkIndexReader:
    """Gathers chunk indexes block by block."""

    def __init__(self, file: RawFile) -> None:
        self._file = file
        self._parts: list[tuple[npt.NDArray[Any], ...]] = []

    def add(self, block: bytes, records: Column, offset: int) -> None:
        """Takes the records at the places `records` of a block that lies at `offset`. Raises `DamagedError`."""
        if not len(records):
            return
        data = np.frombuffer(block, np.uint8)
        self._require(records + _LEAST <= len(block), records, offset)
        head = _gathered(data, records, _HEAD)
        table = head["table"].astype(np.int64)
        lengths = _gathered(data, records + 1, np.dtype([("length", "<i8")]))["length"]
        after = records + _HEAD.itemsize + table
        self._require((lengths >= 0) & (table % _PLACE.itemsize == 0), records, offset)
        self._require(after + _MIDDLE.itemsize + _SIZES.itemsize <= records + RECORD.size + lengths, records, offset)
        middle = _gathered(data, after, _MIDDLE)
        after += _MIDDLE.itemsize + middle["name"].astype(np.int64)
        self._require(after + _SIZES.itemsize <= records + RECORD.size + lengths, records, offset)
        counts = table // _PLACE.itemsize
        ordinals = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
        places = np.repeat(records + _HEAD.itemsize, counts) + _PLACE.itemsize * ordinals
        self._parts.append(
            (
                head["start"].copy(),
                head["length"].copy(),
                _gathered(data, after, _SIZES)["size"].copy(),
                np.clip(middle["index_length"], -1, 2**32 - 2).astype(np.uint32),
                head["first"].copy(),
                head["last"].copy(),
                _gathered(data, places, _PLACE)["channel"].copy(),
                counts,
            )
        )

    def done(self) -> ChunkIndexes:
        """All of them. Raises `DamagedError` where chunks overlap each other or the file's end: what is read is bounded
        by the size of the file."""
        columns: list[npt.NDArray[Any]] = []
        parts = [list(part) for part in self._parts]
        self._parts.clear()
        kinds = (np.int64, np.int64, np.int64, np.uint32, np.int64, np.int64, np.uint16, np.int64)
        for k, kind in enumerate(kinds):
            columns.append(np.concatenate([np.empty(0, kind), *(part[k] for part in parts)]))
            for part in parts:
                part[k] = columns[0][:0]
        counts = columns.pop()
        rows = np.zeros(len(counts) + 1, np.int64)
        np.cumsum(counts, out=rows[1:])
        starts, lengths, sizes, index_lengths, firsts, lasts, channels = columns
        found = ChunkIndexes(starts, lengths, sizes, index_lengths, firsts, lasts, channels, rows)
        if (np.diff(found.starts) < 0).any():
            order = np.argsort(found.starts, kind="stable")
            places, rows = _spread(found.rows, order)
            starts, lengths, sizes, index_lengths, firsts, lasts = (column[order] for column in columns[:6])
            found = ChunkIndexes(starts, lengths, sizes, index_lengths, firsts, lasts, channels[places], rows)
        self._check(found)
        wrong = found.lasts < found.firsts  # times before the epoch, which are large as the unsigned numbers of a file
        found.firsts[wrong], found.lasts[wrong] = _UNBOUNDED.min, _UNBOUNDED.max
        return found

    def _check(self, found: ChunkIndexes) -> None:
        file, size = self._file, self._file.size
        ends = found.starts + np.clip(found.lengths, 0, size) + found.index_lengths
        low = np.concatenate([[RECORD.size - 1], ends[:-1]])[: len(ends)]
        beside = (found.starts < low) | (found.lengths < RECORD.size) | (found.starts > size)
        if beside.any():
            at = int(found.starts[np.argmax(beside)])
            raise file.damaged(f"its index puts a chunk at byte {at}, among other records")
        beyond = (found.lengths > size) | (ends > size)
        if beyond.any():
            at = int(found.starts[np.argmax(beyond)])
            raise file.damaged(f"its index puts a chunk at byte {at} that ends beyond the file's {size} bytes")

    def _require(self, sound: npt.NDArray[np.bool_], records: Column, offset: int) -> None:
        if not sound.all():
            at = offset + int(records[np.argmin(sound)])
            raise self._file.damaged(f"the ChunkIndex record at byte {at} cannot be read: it is too short")


def _gathered(data: npt.NDArray[np.uint8], places: Column, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """The structures at some places of the data, which has them whole."""
    windows = np.lib.stride_tricks.sliding_window_view(data, kind.itemsize)
    return windows[places].view(kind)[:, 0]
