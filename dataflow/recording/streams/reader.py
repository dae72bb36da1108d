"""Reads recordings: our own, torn ones too, and other programs' MCAP files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from mcap.records import Channel

from dataflow.messages.digest import StreamDigest
from dataflow.recording.errors import DamagedError, RecordingError
from dataflow.recording.layout import FORMAT, RECORDING, Kind
from dataflow.recording.mcap.attachments import Attachment
from dataflow.recording.mcap.contents import Entries
from dataflow.recording.mcap.index import McapFile, RawMessage, opened
from dataflow.recording.mcap.rawfile import Watch
from dataflow.recording.notices import notice
from dataflow.recording.streams.access import StreamIndex
from dataflow.recording.streams.codecs import codec_for
from dataflow.recording.streams.entries import Event, RawRecord, Recorded
from dataflow.recording.streams.json_codec import decode_object
from dataflow.recording.streams.json_columns import Values
from dataflow.recording.streams.logs import LogLine
from dataflow.recording.streams.ordering import NOWHERE, Row, in_file_order, merged, rows
from dataflow.recording.streams.part_folder import PartedFile, parts_in
from dataflow.recording.streams.streams import (
    IndexedStream,
    StreamChannel,
    StreamFinder,
    StreamInfo,
    UnreadableMessages,
    decoded,
    unreadable,
)
from dataflow.recording.streams.tracks import tracks


class Recording:
    """A recording opened for reading: a context manager, with random access. Not thread-safe.

    Opens our own recordings, a folder of the parts of one (NAME_000.mcap and so on), and any other MCAP. A file without
    an index (torn by `kill -9`, or foreign) is indexed by a pass over it. Raises `RecordingError` for a file that is no
    MCAP, and for one of ours that is damaged; messages of other programs that cannot be read are passed over
    (`unread`).
    """

    def __init__(self, path: str | Path, *, watch: Watch | None = None, file: McapFile | None = None) -> None:
        """`watch` is called before every read of the file: a sign of progress while a long one is opened or read.
        `file`: the same, opened already; it is closed with this."""
        self.path = Path(path)
        parts = parts_in(self.path) if self.path.is_dir() else []
        self._file: McapFile | PartedFile = (
            PartedFile(self.path, parts, watch=watch) if parts else file or opened(self.path, watch=watch)
        )
        try:
            self.metadata: Mapping[str, Mapping[str, str]] = merged_metadata(self._file.metadata)
            _check_format(self.path, self.metadata)
            self._streams = StreamFinder(self._file).all()
        except BaseException:
            self._file.close()
            raise
        self.streams: Mapping[str, StreamInfo] = {name: s.info for name, s in self._streams.items()}

    @property
    def torn(self) -> bool:
        """Returns whether the file has no proper end: it is being written, or its writer died. The rest can be read."""
        return self._file.torn

    @property
    def nbytes(self) -> int:
        """Bytes of the file, or of all parts."""
        return self._file.nbytes

    @property
    def lost_bytes(self) -> int:
        """Bytes of the unfinished record at the end of a torn file."""
        return self._file.lost_bytes

    @property
    def damage(self) -> tuple[str, ...]:
        """Returns notes on damage in the file, for people: read by other means, or left out, as each note states.
        Damage that cannot be got round raises `RecordingError` when the file is opened or the message is read."""
        return tuple(self._file.damage)

    @property
    def lacking(self) -> Sequence[str]:
        """Missing parts of the file whose messages are not counted anywhere, for people."""
        return self._file.lacking

    @property
    def unread(self) -> Mapping[str, UnreadableMessages]:
        """By stream the messages of other programs that were passed over, since they cannot be read; complete for those
        streams that have been read."""
        return {name: s.unread for name, s in self._streams.items() if s.unread is not None}

    def attachments(self) -> Iterator[Attachment]:
        """Yields the files that it carries, as far as they can be read; `damage` notes the others."""
        return map(self._file.attachment, self._file.attachments)

    @property
    def library(self) -> str:
        """The program that wrote the file, as it calls itself."""
        return str(self._file.header.library)

    @property
    def profile(self) -> str:
        """The MCAP profile, such as `ros2`; empty for none."""
        return str(self._file.header.profile)

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        """Messages with start ≤ stamp ≤ end (ns), merged by (stamp, stream), whatever their order in the file.

        Static streams come first and whole, whatever `start` and `end`. Each stream keeps its own order; an incarnation
        whose clock has jumped back is merged as if it followed directly on the one before. Memory holds the index and
        16 MiB of decompressed chunks, or up to 256 MiB where more are in use at a time. Without `streams`, those that
        have no message type are left out.

        Raises `RecordingError` for an unknown stream, one without a message type, and data that does not decode.
        """
        chosen = self._choose(streams)
        static = [s for s in chosen if s.info.static]
        moving = [s for s in chosen if not s.info.static]
        yield from self._merge(static, None, None)
        yield from self._merge(moving, start, end)

    def stamps(self, stream: str, start: int | None = None, end: int | None = None) -> Iterator[int]:
        """The stamps of what `messages()` gives of one stream, in that order, from the index alone."""
        found = self._stream(stream)
        rows_of = self._rows([found], start, end, by_log_time=False)
        return (row[4] if found.own else row[0] for _, row in rows_of)

    def index(self, stream: str, start: int | None = None, end: int | None = None) -> StreamIndex:
        """Random access to the messages of one stream with start ≤ stamp ≤ end (ns), in the order of `messages()`.

        Nothing is decoded before it is asked for, foreign streams aside, whose stamps lie within their messages. Valid
        until the recording is closed. Raises `RecordingError` as `messages()` does.
        """
        (found,) = self._choose([stream])
        return StreamIndex(
            rows(tracks(self._file, found, start, end), start, end),
            read=lambda row: self._recorded(found, row),
            columns=lambda rows, names: self._columns(found, rows, names),
            stamped_by_log_time=found.own,
        )

    def raw(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[RawRecord]:
        """Undecoded messages of any streams with start ≤ log time ≤ end, merged by (log time, stream)."""
        chosen = [self._stream(name) for name in (self._streams if streams is None else streams)]
        damaged: Counter[str] = Counter()
        for stream, (_, owner, chunk, offset, time, _, _, _) in self._rows(chosen, start, end, by_log_time=True):
            try:
                raw = self._file.read(stream.channels[owner].record.id, chunk, offset, time)
            except DamagedError as error:
                if self._file.own:
                    raise
                damaged[stream.info.name] += 1
                stream.pass_over(damaged[stream.info.name], error.what)
                continue
            info, data = stream.info, bytes(raw.data)
            record = RawRecord(info.name, info.schema, info.encoding, raw.log_time, raw.sequence, data)
            del raw, data  # it holds its chunk in memory
            yield record
            del record

    def firings(
        self, operator: str | None = None, start: int | None = None, end: int | None = None, *, skip: int = 0
    ) -> Iterator[tuple[str, bytes]]:
        """(operator, payload) of every batch of firing records, of one operator or of all, in file order: all of them,
        or those with log times from `start` to `end` (ns) and the next one of each operator, without the first `skip`.
        A batch's log time is the stamp of its last record.

        One pass: they lie in separate chunks, without the messages of streams (in older recordings among them).
        """
        channels = {
            c.id: c.metadata.get("operator", "")
            for c in self._channels_of(Kind.FIRINGS)
            if operator is None or c.metadata.get("operator", "") == operator
        }
        left = set(channels)
        for raw in self._in_file_order(list(channels), start, skip=skip):
            if raw.channel not in left:
                continue
            yield channels[raw.channel], bytes(raw.data)
            if end is not None and raw.log_time > end:
                left.discard(raw.channel)
                if not left:
                    break

    def firing_batches(self) -> Mapping[str, int]:
        """Number of batches of firing records by operator."""
        counts: dict[str, int] = {}
        for channel in self._channels_of(Kind.FIRINGS):
            name = channel.metadata.get("operator", "")
            counts[name] = counts.get(name, 0) + self._file.index.count(channel.id)
        return dict(sorted(counts.items()))

    def counts(self, stream: str, start: int | None = None) -> Mapping[int, int]:
        """Stored messages of a stream by incarnation, all or those with log times from `start` (ns) on; empty for a
        stream that the file does not hold."""
        found: dict[int, int] = {}
        if stream in self._streams:
            for channel in self._streams[stream].channels:
                found[channel.incarnation] = found.get(channel.incarnation, 0) + channel.count_from(start)
        return found

    def events(self) -> Iterator[Event]:
        """Events of the run, in file order."""
        for raw in self._in_file_order([c.id for c in self._channels_of(Kind.EVENTS)]):
            value = decode_object(raw.data)
            try:
                yield Event(value["event"], int(value["stamp"]), value["data"])
            except (KeyError, TypeError, ValueError) as error:
                raise RecordingError(f"{self.path}: an event at {raw.log_time} cannot be read: {error!r}") from error

    def logs(self) -> Iterator[tuple[int, LogLine]]:
        """(log time, line) of the run's log, in file order: event time, or what was the newest when it was said."""
        for raw in self._in_file_order([c.id for c in self._channels_of(Kind.LOGS)]):
            try:
                yield raw.log_time, LogLine.of_recorded(decode_object(raw.data))
            except (KeyError, TypeError, ValueError, IndexError) as error:
                raise RecordingError(f"{self.path}: a line of the log cannot be read: {error!r}") from error

    def digests(self, streams: Sequence[str] | None = None) -> Mapping[str, str]:
        """The stream digests of the decoded messages: xxh3-128 over the message digests, in stream order."""
        found: dict[str, str] = {}
        for stream in sorted(self._choose(streams), key=lambda s: s.info.name):
            digest = StreamDigest()
            for recorded in self._merge([stream], None, None):
                digest.update(recorded.message.digest())
            found[stream.info.name] = digest.hexdigest()
        return found

    def opening(self) -> Mapping[str, Any] | None:
        """None: the path alone suffices to open the same streams in another process."""
        return None

    def close(self) -> None:
        """Closes the file, and announces what was passed over (`notices`). Idempotent."""
        notice(self.path, [f"{self.path.name}: {name}: {unread}" for name, unread in self.unread.items()])
        self._file.close()

    def __repr__(self) -> str:
        return f"<recording {self.path}: {len(self.streams)} streams>"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------- streams

    def _channels_of(self, kind: Kind) -> list[Channel]:
        return [c for c in self._file.channels.values() if c.metadata.get("kind") == kind]

    def _stream(self, name: str) -> IndexedStream:
        found = self._streams.get(name)
        if found is None:
            raise RecordingError(
                f"{self.path} holds no stream {name!r}; it holds {', '.join(self._streams) or 'no streams'}"
            )
        return found

    def _choose(self, names: Sequence[str] | None) -> list[IndexedStream]:
        if names is None:
            return [s for s in self._streams.values() if s.info.message_type is not None]
        chosen = [self._stream(name) for name in dict.fromkeys(names)]
        for stream in chosen:
            if stream.info.message_type is None and stream.info.count:
                kind = stream.info.metadata.get("message_type")
                raise RecordingError(
                    f"{self.path}: stream {stream.info.name!r} holds {stream.info.encoding} messages of "
                    f"{kind or stream.info.schema or 'no schema'}, for which no message type is declared here; "
                    + ("import the module that declares it, or " if kind else "")
                    + "read it with raw()"
                )
        return chosen

    # ------------------------------------------------------------------------------------------------- messages

    def _merge(self, streams: list[IndexedStream], start: int | None, end: int | None) -> Iterator[Recorded]:
        for stream, row in self._rows(streams, start, end, by_log_time=False):
            yield self._recorded(stream, row)

    def _recorded(self, stream: IndexedStream, row: Row) -> Recorded:
        channel, raw, extra = self._stored(stream, row)
        message = decoded(self.path, stream.info.name, channel, raw, extra)
        seq = channel.base + raw.sequence if stream.own else row[7]
        return Recorded(stream.info.name, message, seq, channel.incarnation)

    def _columns(self, stream: IndexedStream, rows: Sequence[Row], names: Collection[str]) -> dict[str, Values]:
        """The named fields of some messages."""
        message_type = stream.info.message_type
        if not stream.own or message_type is None:
            messages = [self._recorded(stream, row).message for row in rows]
            return {name: [getattr(message, name) for message in messages] for name in names}
        codec = codec_for(message_type)
        stored = [self._stored(stream, row) for row in rows]
        try:
            return codec.columns([(raw.data, extra) for _, raw, extra in stored], names)
        except RecordingError:
            for _, raw, extra in stored:  # one of them is to blame
                try:
                    codec.fields(raw.data, extra, names)
                except RecordingError as error:
                    raise unreadable(self.path, stream.info.name, raw, str(error)) from error
            raise

    def _stored(self, stream: IndexedStream, row: Row) -> tuple[StreamChannel, RawMessage, memoryview | None]:
        """The data of a message and of its companion, and the channel that holds it."""
        _, owner, chunk, offset, time, companion_chunk, companion_offset, _ = row
        channel = stream.channels[owner]
        raw = self._file.read(channel.record.id, chunk, offset, time)
        if channel.companion is None or companion_chunk == NOWHERE:
            return channel, raw, None
        companion = self._file.read(channel.companion, companion_chunk, companion_offset, time)
        if companion.sequence != raw.sequence:
            raise unreadable(self.path, stream.info.name, raw, f"its companion is numbered {companion.sequence}")
        return channel, raw, companion.data

    def _rows(
        self, streams: list[IndexedStream], start: int | None, end: int | None, *, by_log_time: bool
    ) -> Iterator[tuple[IndexedStream, Row]]:
        """The merged sequence: always the stream whose next message has the smallest (stamp, stream)."""
        ordered = sorted(streams, key=lambda s: s.info.name)
        cursors = [
            rows(tracks(self._file, stream, start, end, by_log_time=by_log_time), start, end) for stream in ordered
        ]
        return ((ordered[i], row) for i, row in merged(cursors))

    def _in_file_order(
        self, channels: list[int], start: int | None = None, end: int | None = None, *, skip: int = 0
    ) -> Iterator[RawMessage]:
        passed = 0
        for before, part in self._file.index.in_file_order(channels, start, end, skip):
            if start is not None or end is not None:
                before, part = passed, {channel: _within(found, start, end) for channel, found in part.items()}
            for place in in_file_order(list(part.items()), max(0, skip - before)):
                yield self._file.read(*place)
            passed = before + sum(map(len, part.values()))


def _within(entries: Entries, start: int | None, end: int | None) -> Entries:
    kept = np.ones(len(entries), bool)
    if start is not None:
        kept &= entries.times >= start
    if end is not None:
        kept &= entries.times <= end
    return entries.where(kept)


def merged_metadata(records: list[tuple[str, dict[str, str]]]) -> dict[str, dict[str, str]]:
    """Metadata by name; of one name and key the latest counts."""
    merged: dict[str, dict[str, str]] = {}
    for name, mapping in records:
        merged.setdefault(name, {}).update(mapping)
    return merged


def _check_format(path: Path, metadata: Mapping[str, Mapping[str, str]]) -> None:
    """Raises `RecordingError` for a recording in a format that this version does not read. Other programs' files, which
    name none, pass."""
    ours = metadata.get(RECORDING, {})
    found = ours.get("format", FORMAT)
    if "namespace" in ours and found != FORMAT:
        raise RecordingError(
            f"{path} has recording format {found!r}, and this version reads format {FORMAT!r}: open it with a newer "
            "robot-dataflow"
        )
