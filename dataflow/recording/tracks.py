"""The messages of a stream in the order in which they are read, as blocks out of the index of its file."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from dataflow.recording.contents import Entries
from dataflow.recording.errors import RecordingError
from dataflow.recording.ordering import Block, Pairs, Track, companions_of
from dataflow.recording.streams import File, IndexedStream, StreamChannel, unordered


def tracks(
    file: File, stream: IndexedStream, start: int | None, end: int | None, *, by_log_time: bool = False
) -> Iterator[Track]:
    """The incarnations of a stream, one after the other, or all channels of a foreign one."""
    if stream.own:
        for channel in stream.channels:
            yield Track(channel.span, 1, _blocks(file, stream, channel, by_log_time, start, end))
        return
    entries = [c.entries for c in stream.channels]
    times = [c.entries.times if by_log_time else _stamps(file, stream, c) for c in stream.channels]
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
    parts = list(file.index.blocks(channel.companion, *(span or (None, None))))
    companion = Entries(*map(np.concatenate, zip(*(part.columns for part in parts), strict=True)))
    if span is not None:
        companion = companion.where((companion.times >= span[0]) & (companion.times <= span[1]))
    found = companions_of(entries.times, companion)
    if found is None:
        raise RecordingError(f"{file.path}: stream {stream.info.name!r} has companion messages of messages it lacks")
    return found


def _stamps(file: File, stream: IndexedStream, channel: StreamChannel) -> npt.NDArray[np.int64]:
    """The stamps of a channel by entry; those of foreign messages lie within them, so that takes one pass.

    Foreign messages of which two carry the same time are stamped with their log times instead.
    """
    if channel.stamps is None:
        count = len(channel.entries)
        decoded = (message.stamp for message in unordered(file, stream.info.name, channel))
        channel.stamps = np.fromiter(decoded, np.int64, count)
        if len(np.unique(channel.stamps)) < count:
            channel.stamps, channel.by_log_time = channel.entries.times, True
    return channel.stamps
