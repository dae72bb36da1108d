"""The chunk index records of a summary, as columns: ten million of them are read in seconds.

Layout: https://mcap.dev/spec (chunk index, op=0x08).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.recording.mcap.chunks import Column
from dataflow.recording.mcap.rawfile import RECORD, RawFile

_HEAD = np.dtype(
    [("record", "V9"), ("first", "<i8"), ("last", "<i8"), ("start", "<i8"), ("length", "<i8"), ("table", "<u4")]
)
_PLACE = np.dtype([("channel", "<u2"), ("offset", "<i8")])
_MIDDLE = np.dtype([("index_length", "<i8"), ("name", "<u4")])
_SIZES = np.dtype([("packed", "<i8"), ("size", "<i8")])
SEGMENT = 2**20
"""Chunks that are looked at together, so that little more than the columns is in memory."""
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
    lengths: npt.NDArray[np.uint32]
    sizes: npt.NDArray[np.uint32]
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

    def channels_of_all(self, numbers: Column) -> tuple[Column, npt.NDArray[np.uint16]]:
        """The channels of the messages of some chunks: each with the place of its chunk among `numbers`, which come
        first."""
        places, rows = _spread(self.rows, numbers)
        return np.repeat(np.arange(len(numbers)), np.diff(rows)), self.channels[places]

    @property
    def ordered(self) -> bool:
        """Returns whether no chunk begins before the one in front of it."""
        return all((np.diff(self.firsts[k : k + SEGMENT + 1]) >= 0).all() for k in range(0, len(self), SEGMENT))

    def holding(self, channels: npt.ArrayLike, start: int | None = None, end: int | None = None) -> Iterator[Column]:
        """The numbers of the chunks with messages of some channels, in a span of log times that may have any, some of
        them at a time."""
        wanted = np.zeros(2**16, bool)
        wanted[np.asarray(channels, np.int64)] = True
        for low in range(0, len(self), SEGMENT):
            high = min(low + SEGMENT, len(self))
            within = self.lasts[low:high] >= (_UNBOUNDED.min if start is None else start)
            within &= self.firsts[low:high] <= (_UNBOUNDED.max if end is None else end)
            if not within.any():
                continue
            rows = self.rows[low : high + 1]
            held = wanted[self.channels[rows[0] : rows[-1]]]
            within &= np.logical_or.reduceat(held, rows[:-1] - rows[0])
            yield low + np.flatnonzero(within)


def _spread(rows: Column, numbers: Column) -> tuple[Column, Column]:
    """Returns the places in `channels` of some chunks, and what `rows` is for these alone."""
    counts = rows[numbers + 1] - rows[numbers]
    own = np.concatenate([[0], np.cumsum(counts)])
    return np.repeat(rows[numbers] - own[:-1], counts) + np.arange(own[-1]), own


class ChunkIndexReader:
    """Gathers chunk indexes block by block, of a summary of `size` bytes: as many as it can hold have room, and what is
    not used of it takes no memory."""

    def __init__(self, file: RawFile, size: int) -> None:
        self._file = file
        most, kinds = size // _LEAST + 1, (np.int64, np.uint32, np.uint32, np.uint32, np.int64, np.int64, np.uint32)
        self._columns: list[npt.NDArray[Any]] = [np.empty(most, kind) for kind in kinds]
        self._channels = np.empty(size // _PLACE.itemsize + 1, np.uint16)
        self._count = self._entries = 0

    def add(self, block: bytes, records: Column, offset: int) -> None:
        """Takes the records at the places `records` of a block that lies at `offset`. Raises `DamagedError`."""
        if not len(records):
            return
        data = np.frombuffer(block, np.uint8)
        self._require(records + _LEAST <= len(block), records, offset)
        head = gathered(data, records, _HEAD)
        table = head["table"].astype(np.int64)
        lengths = gathered(data, records + 1, np.dtype([("length", "<i8")]))["length"]
        after = records + _HEAD.itemsize + table
        self._require((lengths >= 0) & (table % _PLACE.itemsize == 0), records, offset)
        self._require(after + _MIDDLE.itemsize + _SIZES.itemsize <= records + RECORD.size + lengths, records, offset)
        middle = gathered(data, after, _MIDDLE)
        after += _MIDDLE.itemsize + middle["name"].astype(np.int64)
        self._require(after + _SIZES.itemsize <= records + RECORD.size + lengths, records, offset)
        counts = table // _PLACE.itemsize
        ordinals = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
        places = np.repeat(records + _HEAD.itemsize, counts) + _PLACE.itemsize * ordinals
        values = (
            head["start"],
            _clipped(head["length"]),
            _clipped(gathered(data, after, _SIZES)["size"]),
            _clipped(middle["index_length"]),
            head["first"],
            head["last"],
            counts,
        )
        for column, value in zip(self._columns, values, strict=True):
            column[self._count : self._count + len(records)] = value
        self._count += len(records)
        self._channels[self._entries : self._entries + len(places)] = gathered(data, places, _PLACE)["channel"]
        self._entries += len(places)

    def done(self) -> ChunkIndexes:
        """All of them. Raises `DamagedError` where chunks overlap each other or the file's end: what is read is bounded
        by the size of the file."""
        columns = [column[: self._count] for column in self._columns]
        counts, channels = columns.pop(), self._channels[: self._entries]
        rows = np.zeros(len(counts) + 1, np.int64)
        np.cumsum(counts, out=rows[1:])
        del counts
        self._columns.clear()
        starts, lengths, sizes, index_lengths, firsts, lasts = columns
        found = ChunkIndexes(starts, lengths, sizes, index_lengths, firsts, lasts, channels, rows)
        if any((np.diff(starts[k : k + SEGMENT + 1]) < 0).any() for k in range(0, len(starts), SEGMENT)):
            order = np.argsort(found.starts, kind="stable")
            places, rows = _spread(found.rows, order)
            starts, lengths, sizes, index_lengths, firsts, lasts = (column[order] for column in columns)
            found = ChunkIndexes(starts, lengths, sizes, index_lengths, firsts, lasts, channels[places], rows)
        self._check(found)
        wrong = found.lasts < found.firsts  # times before the epoch, which are large as the unsigned numbers of a file
        found.firsts[wrong], found.lasts[wrong] = _UNBOUNDED.min, _UNBOUNDED.max
        return found

    def _check(self, found: ChunkIndexes) -> None:
        file, size, free = self._file, self._file.size, RECORD.size - 1
        for k in range(0, len(found), SEGMENT):
            part = slice(k, k + SEGMENT)
            starts, lengths = found.starts[part], found.lengths[part].astype(np.int64)
            ends = np.clip(starts, 0, size) + lengths + found.index_lengths[part]
            low = np.concatenate([[free], ends[:-1]])
            beside = (starts < low) | (lengths < RECORD.size) | (starts > size)
            if beside.any():
                at = int(starts[np.argmax(beside)])
                raise file.damaged(f"its index puts a chunk at byte {at}, among other records")
            if (ends > size).any():
                at = int(starts[np.argmax(ends > size)])
                raise file.damaged(f"its index puts a chunk at byte {at} that ends beyond the file's {size} bytes")
            free = int(ends[-1])

    def _require(self, sound: npt.NDArray[np.bool_], records: Column, offset: int) -> None:
        if not sound.all():
            at = offset + int(records[np.argmin(sound)])
            raise self._file.damaged(f"the ChunkIndex record at byte {at} cannot be read: it is too short")


def _clipped(values: Column) -> npt.NDArray[np.uint32]:
    """Sizes, which are below 4 GiB; larger ones are refused when they are read."""
    return np.where((values < 0) | (values >= 2**32), 2**32 - 1, values).astype(np.uint32)


def gathered(data: npt.NDArray[np.uint8], places: Column, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """The structures at some places of the data, which has them whole."""
    if not len(places):
        return np.empty(0, kind)
    windows: npt.NDArray[Any] = np.ndarray((len(data) - kind.itemsize + 1,), kind, data, strides=(1,))
    return windows[places]
