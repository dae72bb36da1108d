"""The messages of a stream in the order in which they are read, as blocks out of the index of its file."""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from dataflow.recording.errors import DamagedError, RecordingError
from dataflow.recording.mcap.contents import Entries
from dataflow.recording.streams.ordering import Block, Pairs, Track, companions_of
from dataflow.recording.streams.streams import File, IndexedStream, StreamChannel, message_at


def tracks(
    file: File, stream: IndexedStream, start: int | None, end: int | None, *, by_log_time: bool = False
) -> Iterator[Track]:
    """The incarnations of a stream, one after the other, or all channels of a foreign one."""
    if stream.own:
        for channel in stream.channels:
            yield Track(channel.span, 1, _blocks(file, stream, channel, by_log_time, start, end))
        return
    found = [(c.entries, c.entries.times) if by_log_time else _stamped(file, stream, c) for c in stream.channels]
    entries, times = [e for e, _ in found], [t for _, t in found]
    if any(map(len, times)):
        span = min(int(t.min()) for t in times if len(t)), max(int(t.max()) for t in times if len(t))
        yield Track(span, len(entries), [Block(entries, times, [None] * len(entries))])


def _blocks(
    file: File, stream: IndexedStream, channel: StreamChannel, by_log_time: bool, start: int | None, end: int | None
) -> Iterator[Block]:
    """The messages of one incarnation."""
    for entries in file.index.blocks(channel.record.id, start, end):
        if len(entries):
            companions = None if by_log_time else _companions(file, stream, channel, entries)
            yield Block([entries], [entries.times], [companions])


def _companions(file: File, stream: IndexedStream, channel: StreamChannel, entries: Entries) -> Pairs | None:
    if channel.companion is None:
        return None
    whole = len(entries) == channel.count
    span = None if whole else (int(entries.times.min()), int(entries.times.max()))
    companion = Entries.joined(file.index.blocks(channel.companion, *(span or (None, None))))
    if span is not None:
        companion = companion.where((companion.times >= span[0]) & (companion.times <= span[1]))
    found = companions_of(entries.times, companion)
    if found is None:
        raise RecordingError(f"{file.path}: stream {stream.info.name!r} has companion messages of messages it lacks")
    return found


def _stamped(file: File, stream: IndexedStream, channel: StreamChannel) -> tuple[Entries, npt.NDArray[np.int64]]:
    """The messages of a foreign channel that can be read, and their stamps, which lie within them: that takes one pass.

    Messages of which two carry the same time are stamped with their log times instead.
    """
    if channel.readable is None or channel.stamps is None:
        entries, stamps, kept = channel.entries, array("q"), array("q")
        before = sum(len(c.entries) - len(c.readable) for c in stream.channels if c.readable is not None)
        for i in range(len(entries)):
            try:
                stamps.append(message_at(file, stream.info.name, channel, entries, i).stamp)
                kept.append(i)
            except RecordingError as error:
                if isinstance(error, DamagedError) and file.own:
                    raise
                stream.pass_over(before + i + 1 - len(kept), getattr(error, "what", "") or str(error))
        channel.readable, channel.stamps = entries.where(np.array(kept, np.int64)), np.array(stamps, np.int64)
        if len(np.unique(channel.stamps)) < len(channel.stamps):
            channel.stamps, channel.by_log_time = channel.readable.times, True
    return channel.readable, channel.stamps
