"""Places of the messages of an MCAP file, by channel: all in memory, or of a long file read as they are asked for."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from dataflow.recording.mcap.chunk_indexes import ChunkIndexes, gathered
from dataflow.recording.mcap.chunks import Chunks, Column
from dataflow.recording.mcap.contents import NO_ENTRIES, Contents, Entries
from dataflow.recording.mcap.rawfile import RECORD, RawFile
from dataflow.recording.mcap.seals import Seal, seal_of

STEP = 4096
"""Chunks whose messages are looked up together, at most."""
STEP_BYTES = 2**22
"""Bytes of their message indexes, 16 a message, beyond which no further chunk is: so much of a long file is in memory
meanwhile."""
MANY = 8
"""Channels of a chunk, for each chunk that is looked up, beyond which record by record is quicker."""
SAMPLED = 1024
"""Chunks of a long file by which the sizes of its streams are estimated, at most."""
SAMPLED_BYTES = 2**23
"""Bytes of their message indexes, about."""

_HEAD = np.dtype([("opcode", "u1"), ("length", "<i8"), ("channel", "<u2"), ("nbytes", "<u4")])
_ENTRY = np.dtype([("time", "<i8"), ("offset", "<i8")])


class MessageIndex(Protocol):
    """The places of the messages of each channel."""

    def count(self, channel: int) -> int:
        """Messages of a channel."""

    def span(self, channel: int) -> tuple[int, int] | None:
        """The smallest and the largest log time (ns) of a channel; None where it has no message."""

    def entries(self, channel: int) -> Entries:
        """All messages of a channel."""

    def blocks(self, channel: int, start: int | None, end: int | None) -> Iterator[Entries]:
        """The messages of a channel in parts, all log times of one before those of the next: at least those with start
        ≤ log time ≤ end."""

    def in_file_order(
        self, channels: Collection[int], start: int | None = None, end: int | None = None, skip: int = 0
    ) -> Iterator[tuple[int, Mapping[int, Entries]]]:
        """The messages of some channels in parts that follow each other in the file, each with the number of those in
        front of it: at least those with start ≤ log time ≤ end. Without a span, parts that lie wholly among the first
        `skip` messages may be left out."""

    def sample(self) -> tuple[Mapping[int, Entries], Column | None]:
        """Messages by channel from which sizes are estimated, and the chunks that hold them (None: all)."""


class LoadedIndex:
    """The messages in memory, 24 bytes each."""

    def __init__(self, entries: Mapping[int, Entries]) -> None:
        self._entries = entries

    def count(self, channel: int) -> int:
        return len(self.entries(channel))

    def span(self, channel: int) -> tuple[int, int] | None:
        times = self.entries(channel).times
        return (int(times.min()), int(times.max())) if len(times) else None

    def entries(self, channel: int) -> Entries:
        return self._entries.get(channel, NO_ENTRIES)

    def blocks(self, channel: int, start: int | None, end: int | None) -> Iterator[Entries]:
        yield self.entries(channel)

    def in_file_order(
        self, channels: Collection[int], start: int | None = None, end: int | None = None, skip: int = 0
    ) -> Iterator[tuple[int, Mapping[int, Entries]]]:
        yield 0, {channel: self.entries(channel) for channel in channels}

    def sample(self) -> tuple[Mapping[int, Entries], Column | None]:
        return self._entries, None


class LongIndex:
    """The messages of a long file, whose message indexes are read as they are needed.

    `counts`: messages by channel, where the file's statistics count them. Damage found on reading is noted in `damage`.
    """

    def __init__(
        self,
        file: RawFile,
        chunks: Chunks,
        indexes: ChunkIndexes,
        *,
        sealed: bool,
        counts: Mapping[int, int] | None,
        damage: list[str],
    ) -> None:
        self._file, self._chunks, self._indexes = file, chunks, indexes
        self._sealed, self._counts, self._damage = sealed, counts, damage
        self._spans: dict[int, tuple[int, int] | None] = {}
        self._steps_known: dict[tuple[int, ...], int] = {}
        """Messages of channels in those chunks that are looked up together, by the channels and the first chunk."""

    def count(self, channel: int) -> int:
        return self._counts.get(channel, 0) if self._counts is not None else len(self.entries(channel))

    def span(self, channel: int) -> tuple[int, int] | None:
        if channel not in self._spans:
            self._spans[channel] = self._found_span(channel)
        return self._spans[channel]

    def _found_span(self, channel: int) -> tuple[int, int] | None:
        first = self._least(channel, self._indexes.firsts, 1)
        last = self._least(channel, self._indexes.lasts, -1)
        return None if first is None or last is None else (first, -last)

    def _least(self, channel: int, bounds: Column, sign: int) -> int | None:
        """The least log time of a channel, times `sign`; `bounds`: by chunk the least that it can have."""
        least: int | None = None
        for numbers in self._indexes.holding([channel]):
            can = sign * bounds[numbers]
            order = np.argsort(can, kind="stable")
            at, step = 0, 1
            while at < len(order) and (least is None or can[order[at]] < least):
                times = self._load(numbers[order[at : at + step]], [channel])[channel].times
                if len(times):
                    found = int((sign * times).min())
                    least = found if least is None else min(least, found)
                at, step = at + step, min(4 * step, STEP)
        return least

    def entries(self, channel: int) -> Entries:
        return self._all.get(channel, NO_ENTRIES)

    @cached_property
    def _all(self) -> Mapping[int, Entries]:
        return self._load(np.arange(len(self._indexes)), np.unique(self._indexes.channels).tolist())

    def blocks(self, channel: int, start: int | None, end: int | None) -> Iterator[Entries]:
        firsts, held = self._indexes.firsts, NO_ENTRIES
        for numbers in self._by_time(channel, start, end):
            before = held.times < firsts[numbers[0]]
            if before.any():
                yield held.where(before)
                held = held.where(~before)
            loaded = self._load(numbers, [channel])[channel]
            held = Entries.joined((held, loaded)) if len(held) else loaded
        yield held

    def _by_time(self, channel: int, start: int | None, end: int | None) -> Iterator[Column]:
        """The numbers of a channel's chunks in the order of their first times, `STEP` at a time."""
        found = self._indexes.holding([channel], start, end)
        if not self._ordered:
            numbers = np.concatenate([np.empty(0, np.int64), *found])
            found = iter([numbers[np.argsort(self._indexes.firsts[numbers], kind="stable")]])
        for numbers in found:
            yield from steps(self._indexes, numbers)

    @cached_property
    def _ordered(self) -> bool:
        return self._indexes.ordered

    def in_file_order(
        self, channels: Collection[int], start: int | None = None, end: int | None = None, skip: int = 0
    ) -> Iterator[tuple[int, Mapping[int, Entries]]]:
        before, whole = 0, start is None and end is None
        for found in self._indexes.holding(list(channels), start, end):
            for numbers in steps(self._indexes, found):
                key = (*sorted(channels), int(numbers[0]))
                count = self._steps_known.get(key) if whole else None
                if count is None or before + count > skip:
                    loaded = self._load(numbers, channels)
                    count = sum(map(len, loaded.values()))
                    yield before, loaded
                if whole:
                    self._steps_known[key] = count
                before += count

    def sample(self) -> tuple[Mapping[int, Entries], Column | None]:
        lengths = self._indexes.index_lengths
        fitting = SAMPLED_BYTES * len(lengths) // max(int(lengths.sum(dtype=np.int64)), 1)
        count = min(SAMPLED, max(fitting, 1))
        numbers = np.unique(np.linspace(0, len(self._indexes) - 1, count).astype(np.int64))
        return self._load(numbers, np.unique(self._indexes.channels).tolist()), numbers

    def _load(self, numbers: Column, channels: Collection[int]) -> dict[int, Entries]:
        """The messages of some channels in some chunks."""
        wanted = frozenset(channels)
        found = Contents(self._file, self._chunks)
        take_messages(found, self._indexes, numbers, sealed=self._sealed, wanted=wanted)
        self._damage += [note for note in found.damage if note not in self._damage]
        loaded = found.entries()
        return {channel: loaded.get(channel, NO_ENTRIES) for channel in channels}


def steps(indexes: ChunkIndexes, numbers: Column) -> Iterator[Column]:
    """Divides chunks into such as are looked up together."""
    sizes = np.cumsum(indexes.index_lengths[numbers], dtype=np.int64)
    at = 0
    while at < len(numbers):
        before = int(sizes[at - 1]) if at else 0
        end = min(max(int(np.searchsorted(sizes, before + STEP_BYTES, "right")), at + 1), at + STEP)
        yield numbers[at:end]
        at = end


def take_messages(
    contents: Contents, indexes: ChunkIndexes, numbers: Column, *, sealed: bool, wanted: frozenset[int] | None = None
) -> None:
    """Takes the messages of some chunks: by their message indexes, or where these are damaged by the content of the
    chunk, with a note."""
    sound = _sound_entries(contents.file, indexes, numbers, sealed, wanted)
    if sound is not None:
        contents.add_entries(sound)
        return
    for number in numbers.tolist():
        at = int(indexes.starts[number]) + int(indexes.lengths[number])
        bodies = _message_indexes(contents.file, at, indexes, number, sealed, wanted)
        if bodies is None or not contents.add_indexes(number, bodies):
            contents.take_chunk(number)
            contents.damage.append(
                f"the message index at byte {at} is damaged; {contents.chunks.where(number)} was read instead"
            )


def _sound_entries(
    file: RawFile, indexes: ChunkIndexes, numbers: Column, sealed: bool, wanted: frozenset[int] | None
) -> dict[int, Entries] | None:
    """The messages of some chunks by channel, of all channels or of `wanted` ones; None where a message index is
    damaged or contradicts the chunk index, or few chunks hold many channels: this goes from channel to channel."""
    if int(np.diff(indexes.rows)[numbers].max(initial=0)) > MANY * len(numbers):
        return None
    lengths = indexes.index_lengths[numbers].astype(np.int64)
    starts = indexes.starts[numbers] + indexes.lengths[numbers]
    data = b"".join(map(file.read, starts.tolist(), lengths.tolist()))
    view, ends = np.frombuffer(data, np.uint8), np.cumsum(lengths)
    walked = _walked(view, ends - lengths, ends)
    if walked is None:
        return None
    owners, places, heads = walked
    holders, channels = indexes.channels_of_all(numbers)
    there = np.sort((owners << 16) + heads["channel"])
    if not np.array_equal(np.sort((holders << 16) + channels), there) or not np.diff(there).all():
        return None
    order = np.lexsort((owners, heads["channel"]))
    if wanted is not None:
        order = order[np.isin(heads["channel"][order], list(wanted))]
    owners, places, heads = owners[order], places[order], heads[order]
    if sealed:
        records = zip(places.tolist(), (places + RECORD.size + heads["length"]).tolist(), strict=True)
        if any(seal_of(data[place:end]) is not Seal.SOUND for place, end in records):
            return None
    counts = heads["nbytes"].astype(np.int64) // _ENTRY.itemsize
    ordinals = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    entries = gathered(view, np.repeat(places + _HEAD.itemsize, counts) + _ENTRY.itemsize * ordinals, _ENTRY)
    chunks = np.repeat(numbers[owners], counts)
    if ((entries["offset"] < 0) | (entries["offset"] >= indexes.sizes[chunks])).any():
        return None
    columns = entries["time"].astype(np.int64), chunks, entries["offset"].astype(np.int64)
    channels, firsts = np.unique(heads["channel"], return_index=True)
    cuts = (np.cumsum(counts) - counts)[firsts[1:]]
    parts = zip(*(np.split(column, cuts) for column in columns), strict=True)
    return {channel: Entries(*part) for channel, part in zip(channels.tolist(), parts, strict=False)}


def _walked(
    data: npt.NDArray[np.uint8], places: Column, ends: Column
) -> tuple[Column, Column, npt.NDArray[np.void]] | None:
    """The message indexes in areas of `data` from `places` to `ends`: the number of the area of each, its place, its
    head; None where an area does not consist of them."""
    owners, found, heads = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty(0, _HEAD)]
    left = np.flatnonzero(places < ends)
    at = places[left]
    while len(left):
        if (at + _HEAD.itemsize > ends[left]).any():
            return None
        head = gathered(data, at, _HEAD)
        room, nbytes = ends[left] - at - RECORD.size, head["nbytes"].astype(np.int64)
        sound = (head["opcode"] == Opcode.MESSAGE_INDEX) & (head["length"] <= room) & (nbytes % _ENTRY.itemsize == 0)
        if not (sound & (nbytes + _HEAD.itemsize - RECORD.size <= head["length"])).all():
            return None
        owners.append(left)
        found.append(at)
        heads.append(head)
        more = head["length"] < room
        left, at = left[more], (at + RECORD.size + head["length"])[more]
    return np.concatenate(owners), np.concatenate(found), np.concatenate(heads)


def _message_indexes(
    file: RawFile, start: int, indexes: ChunkIndexes, number: int, sealed: bool, wanted: frozenset[int] | None
) -> list[bytes] | None:
    """Returns the bodies of the message indexes behind a chunk, all or those of `wanted` channels; None where they
    contradict the chunk index."""
    data = file.read(start, int(indexes.index_lengths[number]))
    bodies: list[bytes] = []
    found: list[int] = []
    position = 0
    while position + RECORD.size + 2 <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        end = position + RECORD.size + length
        if opcode != Opcode.MESSAGE_INDEX or end > len(data):
            return None
        channel = int.from_bytes(data[position + RECORD.size : position + RECORD.size + 2], "little")
        found.append(channel)
        if wanted is None or channel in wanted:
            if sealed and seal_of(data[position:end]) is not Seal.SOUND:
                return None
            bodies.append(data[position + RECORD.size : end])
        position = end
    return bodies if position == len(data) and sorted(found) == sorted(indexes.channels_of(number)) else None
