"""The order in which the messages of a recording are read: streams merged by (stamp, stream name), from their index."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dataflow.recording.mcap.contents import Entries

BLOCK = 4096
NOWHERE = -2
"""The chunk of a companion that is not there."""

Row = tuple[int, int, int, int, int, int, int, int]
"""A message: what it is merged by, which entries of all its tracks it is of, chunk, offset, log time, chunk and offset
of its companion, and its rank in the stream."""


Pairs = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]
"""Chunk and offset of the companion of each message."""


@dataclass(frozen=True, slots=True)
class Block:
    """Messages that follow each other in a track, by channel.

    `times`: by entries, what the messages are ordered by (ns). `companions`: by entries, those of each message, or None
    where there are none.
    """

    entries: Sequence[Entries]
    times: Sequence[npt.NDArray[np.int64]]
    companions: Sequence[Pairs | None]


@dataclass(frozen=True, slots=True)
class Track:
    """Messages of one stream that are ordered by time: an incarnation, or all channels of a foreign stream.

    `span`: the first and the last time (ns) of all of them; None where there are none. `blocks`: those that may be
    asked for, all times of a block before those of the next.
    """

    span: tuple[int, int] | None
    channels: int
    blocks: Iterable[Block]


def rows(tracks: Iterable[Track], start: int | None, end: int | None) -> Iterator[Row]:
    """The messages of one stream with start ≤ time ≤ end: track after track, by time in each.

    A track whose clock has jumped back is merged as if it followed directly on the one before.
    """
    rank = passed = 0
    newest: int | None = None
    for track in tracks:
        first, last = track.span or (0, 0)
        shift = 0 if newest is None or first > newest else newest + 1 - first
        newest = last + shift if track.span else newest
        for block in track.blocks:
            times, order, columns = _columns(block, passed)
            low = 0 if start is None else int(np.searchsorted(times[order], start, "left"))
            high = len(order) if end is None else int(np.searchsorted(times[order], end, "right"))
            for at in range(low, high, BLOCK):
                part = order[at : min(at + BLOCK, high)]
                keys = (times[part] + shift).tolist()
                ranks = range(rank + at, rank + at + len(part))
                yield from zip(keys, *(c[part].tolist() for c in columns), ranks, strict=True)
            rank += len(order)
        passed += track.channels


def merged(cursors: Sequence[Iterator[Row]]) -> Iterator[tuple[int, Row]]:
    """(cursor, row), always of the cursor whose next row has the smallest key; of equal ones the first cursor."""
    heads = [next(cursor, None) for cursor in cursors]
    heap = [(head[0], i) for i, head in enumerate(heads) if head is not None]
    heapq.heapify(heap)
    while heap:
        i = heap[0][1]
        head = heads[i]
        assert head is not None
        yield i, head
        following = heads[i] = next(cursors[i], None)
        if following is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following[0], i))


def in_file_order(entries: Sequence[tuple[int, Entries]], skip: int = 0) -> Iterator[tuple[int, int, int, int]]:
    """(name, chunk, offset, log time) of all messages of (name, entries) but the first `skip`, as they lie in the
    file."""
    if not entries:
        return
    names = np.concatenate([np.full(len(e), name, np.int64) for name, e in entries])
    chunks = np.concatenate([e.chunks for _, e in entries])
    offsets = np.concatenate([e.offsets for _, e in entries])
    times = np.concatenate([e.times for _, e in entries])
    order = np.lexsort((offsets, chunks))
    for at in range(skip, len(order), BLOCK):
        block = order[at : at + BLOCK]
        yield from zip(*(column[block].tolist() for column in (names, chunks, offsets, times)), strict=True)


def companions_of(times: npt.NDArray[np.int64], companion: Entries) -> Pairs | None:
    """By message of `times`, chunk and offset of the companion message of the same time; NOWHERE where there is none.

    None where a companion message has the time of no message, so that it would be passed over.
    """
    if not len(companion):
        return np.full(len(times), NOWHERE), np.zeros(len(times), np.int64)
    order = np.argsort(companion.times, kind="stable")
    ranks = np.minimum(np.searchsorted(companion.times, times, sorter=order), len(companion) - 1)
    at = order[ranks]
    found = companion.times[at] == times
    if len(np.setdiff1d(companion.times, times)):
        return None
    return np.where(found, companion.chunks[at], NOWHERE), companion.offsets[at]


def _columns(
    block: Block, passed: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], list[npt.NDArray[np.int64]]]:
    """Returns what the messages are ordered by, the order, and the columns of a row between its key and its rank.

    `passed`: channels of the tracks before.
    """
    times = np.concatenate(block.times)
    chunks = np.concatenate([e.chunks for e in block.entries])
    offsets = np.concatenate([e.offsets for e in block.entries])
    log_times = np.concatenate([e.times for e in block.entries])
    owners = np.concatenate([np.full(len(e), i, np.int64) for i, e in enumerate(block.entries, passed)])
    absent = np.full(len(chunks), NOWHERE)
    pairs = [c or (absent[: len(e)], absent[: len(e)]) for c, e in zip(block.companions, block.entries, strict=True)]
    companion_chunks = np.concatenate([chunk for chunk, _ in pairs])
    companion_offsets = np.concatenate([offset for _, offset in pairs])
    order = np.lexsort((offsets, chunks, times))
    return times, order, [owners, chunks, offsets, log_times, companion_chunks, companion_offsets]
