"""Reads recordings: our own, torn ones too, and other programs' MCAP files."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from mcap.records import Channel

from dataflow.messages.base import Message, MessageError, message_types, registered_type
from dataflow.messages.declaration import Declaration, GenericMessage, known_type
from dataflow.messages.digest import StreamDigest
from dataflow.recording.access import StreamIndex
from dataflow.recording.codecs import SchemaText, codec_for, declaration_digest, recorded_declaration
from dataflow.recording.contents import Entries
from dataflow.recording.errors import RecordingError
from dataflow.recording.foreign import foreign_decoder
from dataflow.recording.index import McapFile, RawMessage
from dataflow.recording.json_codec import decode_object
from dataflow.recording.json_columns import Values
from dataflow.recording.layout import Kind
from dataflow.recording.ordering import NOWHERE, Row, Track, companions_of, in_file_order, merged, rows


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording and its place in its stream."""

    stream: str
    message: Message
    seq: int
    incarnation: int

    @property
    def stamp(self) -> int:
        """The timestamp of the message, nanoseconds since the epoch."""
        return self.message.stamp


@dataclass(frozen=True, slots=True)
class RawRecord:
    """One message as it stands in the file, decoded or not."""

    stream: str
    schema: str
    encoding: str
    log_time: int
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to the run."""

    name: str
    stamp: int
    data: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """What a recording knows of one stream without decoding it.

    - `schema`, `encoding`: of the file, such as foxglove.RawImage and protobuf.
    - `declaration`: of a type that the recording itself declares, since it is not of `dataflow.messages`.
    - `known`: the class of any other type; None where this program has none.
    - `first`, `last`: smallest and largest log time (our own recordings: stamp), ns; None for an empty stream.
    - `bytes`: message data before compression, companions included.
    - `metadata`: of the stream's channel.
    """

    name: str
    schema: str
    encoding: str
    declaration: Declaration | None
    known: type[Message] | None
    count: int
    first: int | None
    last: int | None
    static: bool
    bytes: int
    incarnations: int
    metadata: Mapping[str, str]

    @property
    def message_type(self) -> type[Message] | None:
        """The class that its messages are read as; None where there is none.

        Of a type that the recording declares, that is the class of this program with the same fields, from when the
        module that has it is imported; else a class made from the declaration.
        """
        return self.known if self.declaration is None else known_type(self.declaration)

    @property
    def generic(self) -> bool:
        """Whether its messages are read by the recording's declaration, without the class that made them."""
        found = self.message_type
        return found is not None and issubclass(found, GenericMessage)

    @property
    def declared_otherwise(self) -> bool:
        """Whether the type's declaration in this program differs from the one that the messages were written with."""
        if self.declaration is not None:
            return self.generic and registered_type(self.declaration.schema) is not None
        written = self.metadata.get("declaration", "")
        return self.metadata.get("kind") == Kind.STREAM and (
            self.known is not None and written != declaration_digest(self.known)
        )


Decode = Callable[[RawMessage, memoryview | None], Message]
TypeOf = Callable[[], type[Message] | None]


@dataclass(slots=True)
class _Channel:
    """One MCAP channel of a stream: an incarnation, or a part of one."""

    record: Channel
    incarnation: int
    base: int
    entries: Entries
    companion: tuple[int, Entries] | None
    """Id and entries of the companion."""
    decode: Decode | None
    stamps: npt.NDArray[np.int64] | None = None
    """By entry; of foreign channels only known after a pass."""
    by_log_time: bool = False
    """Foreign messages whose own times are not usable."""


@dataclass(slots=True)
class _Stream:
    info: StreamInfo
    own: bool
    channels: list[_Channel] = field(default_factory=list)


_EMPTY = Entries(*(np.empty(0, np.int64) for _ in range(3)))


class Recording:
    """A recording opened for reading: a context manager, with random access. Not thread-safe.

    Opens our own recordings and anybody's MCAP. A file without an index (torn by `kill -9`, or foreign) is indexed by a
    pass over it. Raises `RecordingError` for a file that is no MCAP or is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file = McapFile(self.path)
        try:
            self._streams = self._find_streams()
        except BaseException:
            self._file.close()
            raise
        self.streams: Mapping[str, StreamInfo] = {name: s.info for name, s in self._streams.items()}
        self.metadata: Mapping[str, Mapping[str, str]] = _merged(self._file.metadata)

    @property
    def torn(self) -> bool:
        """Whether the file has no proper end: its writer died. Everything up to the last whole chunk is readable."""
        return self._file.torn

    @property
    def lost_bytes(self) -> int:
        """Bytes of the unfinished record at the end of a torn file."""
        return self._file.lost_bytes

    @property
    def damage(self) -> tuple[str, ...]:
        """What in the file is damaged, for people: it was read by other means, or is left out as the note says.

        Damage that cannot be got round raises `RecordingError` when the file is opened or the message is read.
        """
        return tuple(self._file.damage)

    @property
    def library(self) -> str:
        """The program that wrote the file, as it calls itself."""
        return str(self._file.header.library)

    @property
    def profile(self) -> str:
        """The MCAP profile, such as `ros2`; empty for none."""
        return str(self._file.header.profile)

    def messages(
        self,
        streams: Sequence[str] | None = None,
        start: int | None = None,
        end: int | None = None,
    ) -> Iterator[Recorded]:
        """Messages with start ≤ stamp ≤ end (ns), merged by (stamp, stream), whatever their order in the file.

        Static streams come first and whole, whatever `start` and `end`. Each stream keeps its own order; an incarnation
        whose clock has jumped back is merged as if it followed directly on the one before. Memory holds the index and
        at most 256 MiB of decompressed chunks. Without `streams`, those that have no message type are left out.

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

    def index(self, stream: str, start: int | None = None, end: int | None = None) -> StreamIndex[Recorded]:
        """Random access to the messages of one stream with start ≤ stamp ≤ end (ns), in the order of `messages()`.

        Nothing is decoded before it is asked for, foreign streams aside, whose stamps lie within their messages. Valid
        until the recording is closed. Raises `RecordingError` as `messages()` does.
        """
        (found,) = self._choose([stream])
        return StreamIndex(
            rows(self._tracks(found, False), start, end),
            read=lambda row: self._recorded(found, row),
            columns=lambda rows, names: self._columns(found, rows, names),
            stamped_by_log_time=found.own,
        )

    def raw(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[RawRecord]:
        """Undecoded messages of any streams with start ≤ log time ≤ end, merged by (log time, stream)."""
        chosen = [self._stream(name) for name in (self._streams if streams is None else streams)]
        for stream, (_, owner, chunk, offset, time, _, _, _) in self._rows(chosen, start, end, by_log_time=True):
            raw = self._file.read(stream.channels[owner].record.id, chunk, offset, time)
            info, data = stream.info, bytes(raw.data)
            record = RawRecord(info.name, info.schema, info.encoding, raw.log_time, raw.sequence, data)
            del raw, data  # it holds its chunk in memory
            yield record
            del record

    def firings(self, operator: str | None = None) -> Iterator[tuple[str, bytes]]:
        """(operator, payload) of every batch of firing records, of one operator or of all, in file order.

        One pass: they lie in chunks of their own, without the messages of streams (in older recordings among them).
        """
        channels = {
            c.id: c.metadata.get("operator", "")
            for c in self._channels_of(Kind.FIRINGS)
            if operator is None or c.metadata.get("operator", "") == operator
        }
        for raw in self._in_file_order(list(channels)):
            yield channels[raw.channel], bytes(raw.data)

    def firing_batches(self) -> Mapping[str, int]:
        """Number of batches of firing records by operator."""
        counts: dict[str, int] = {}
        for channel in self._channels_of(Kind.FIRINGS):
            name = channel.metadata.get("operator", "")
            counts[name] = counts.get(name, 0) + len(self._entries(channel.id))
        return dict(sorted(counts.items()))

    def counts(self, stream: str) -> Mapping[int, int]:
        """Stored messages of a stream by incarnation; empty for a stream that the file does not hold."""
        found: dict[int, int] = {}
        if stream in self._streams:
            for channel in self._streams[stream].channels:
                found[channel.incarnation] = found.get(channel.incarnation, 0) + len(channel.entries)
        return found

    def events(self) -> Iterator[Event]:
        """Events of the run, in file order."""
        for raw in self._in_file_order([c.id for c in self._channels_of(Kind.EVENTS)]):
            value = decode_object(raw.data)
            try:
                yield Event(value["event"], int(value["stamp"]), value["data"])
            except (KeyError, TypeError, ValueError) as error:
                raise RecordingError(f"{self.path}: an event at {raw.log_time} cannot be read: {error!r}") from error

    def digests(self, streams: Sequence[str] | None = None) -> Mapping[str, str]:
        """The stream digests of the decoded messages: xxh3-128 over the message digests, in stream order."""
        found: dict[str, str] = {}
        for stream in sorted(self._choose(streams), key=lambda s: s.info.name):
            digest = StreamDigest()
            for recorded in self._merge([stream], None, None):
                digest.update(recorded.message.digest())
            found[stream.info.name] = digest.hexdigest()
        return found

    def close(self) -> None:
        """Closes the file. Idempotent."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------- streams

    def _find_streams(self) -> dict[str, _Stream]:
        sizes = self._file.message_bytes()
        grouped: dict[str, list[Channel]] = {}
        companions: dict[tuple[str, str, str], Channel] = {}
        for channel in self._file.channels.values():
            kind = channel.metadata.get("kind")
            if kind == Kind.COMPANION:
                companions[_key(channel, channel.metadata.get("companion_of", ""))] = channel
            elif kind not in (Kind.FIRINGS, Kind.EVENTS, Kind.FRAMES):
                grouped.setdefault(channel.topic, []).append(channel)
        found = {name: self._find_stream(name, channels, companions, sizes) for name, channels in grouped.items()}
        return dict(sorted(found.items()))

    def _find_stream(
        self,
        name: str,
        records: list[Channel],
        companions: Mapping[tuple[str, str, str], Channel],
        sizes: Mapping[int, int],
    ) -> _Stream:
        first = records[0]
        own = first.metadata.get("kind") == Kind.STREAM
        declaration = recorded_declaration(first.metadata) if own else None
        known = message_types().get(first.metadata.get("message_type", "")) if own else None
        read_as: TypeOf = (lambda: known) if declaration is None else partial(known_type, declaration)
        channels: list[_Channel] = []
        size = 0
        for record in records:
            size += sizes.get(record.id, 0)
            companion = companions.get(_key(record, name)) if own else None
            if companion is not None:
                size += sizes.get(companion.id, 0)
            channels.append(self._own_channel(record, companion, read_as) if own else self._foreign_channel(record))
        channels.sort(key=lambda c: (c.incarnation, c.base))
        if not own:
            known = self._peek(name, channels)
        times = [c.entries.times for c in channels if len(c.entries)]
        schema = self._schema(first)
        info = StreamInfo(
            name=name,
            schema=schema.name,
            encoding=first.message_encoding,
            declaration=declaration,
            known=known,
            count=sum(len(c.entries) for c in channels),
            first=min((int(t.min()) for t in times), default=None),
            last=max((int(t.max()) for t in times), default=None),
            static=first.metadata.get("static") == "true" and own,
            bytes=size,
            incarnations=len({c.incarnation for c in channels if len(c.entries)}),
            metadata=first.metadata,
        )
        return _Stream(info, own, channels)

    def _own_channel(self, record: Channel, companion: Channel | None, read_as: TypeOf) -> _Channel:
        def decode(raw: RawMessage, extra: memoryview | None) -> Message:
            message_type = read_as()
            assert message_type is not None
            return codec_for(message_type).decode(raw.log_time, raw.data, extra)

        entries = self._entries(record.id)
        return _Channel(
            record,
            incarnation=_number(record.metadata.get("incarnation", "0")),
            base=_number(record.metadata.get("sequence_base", "0")),
            entries=entries,
            companion=None if companion is None else (companion.id, self._entries(companion.id)),
            decode=None if read_as() is None else decode,
            stamps=entries.times,
        )

    def _foreign_channel(self, record: Channel) -> _Channel:
        decoder = foreign_decoder(record.message_encoding, self._schema(record))

        def decode(raw: RawMessage, extra: memoryview | None) -> Message:
            assert decoder is not None
            return decoder(bytes(raw.data), raw.log_time)

        return _Channel(record, 0, 0, self._entries(record.id), None, None if decoder is None else decode)

    def _peek(self, name: str, channels: list[_Channel]) -> type[Message] | None:
        """The type of a foreign stream's first message; None when it does not decode."""
        for channel in channels:
            if channel.decode is None or not len(channel.entries):
                continue
            try:
                return type(next(self._unordered(name, channel)))
            except RecordingError:
                channel.decode = None
        return None

    def _entries(self, channel: int) -> Entries:
        return self._file.entries.get(channel, _EMPTY)

    def _schema(self, channel: Channel) -> SchemaText:
        schema = self._file.schemas.get(channel.schema_id)
        return SchemaText("", "", b"") if schema is None else SchemaText(schema.name, schema.encoding, schema.data)

    def _channels_of(self, kind: Kind) -> list[Channel]:
        return [c for c in self._file.channels.values() if c.metadata.get("kind") == kind]

    def _stream(self, name: str) -> _Stream:
        found = self._streams.get(name)
        if found is None:
            raise RecordingError(
                f"{self.path} holds no stream {name!r}; it holds {', '.join(self._streams) or 'no streams'}"
            )
        return found

    def _choose(self, names: Sequence[str] | None) -> list[_Stream]:
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

    def _merge(self, streams: list[_Stream], start: int | None, end: int | None) -> Iterator[Recorded]:
        for stream, row in self._rows(streams, start, end, by_log_time=False):
            yield self._recorded(stream, row)

    def _recorded(self, stream: _Stream, row: Row) -> Recorded:
        channel, raw, extra = self._stored(stream, row)
        message = self._decode(stream.info.name, channel, raw, extra)
        seq = channel.base + raw.sequence if stream.own else row[7]
        return Recorded(stream.info.name, message, seq, channel.incarnation)

    def _columns(self, stream: _Stream, rows: Sequence[Row], names: Collection[str]) -> dict[str, Values]:
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
                    raise self._unreadable(stream.info.name, raw, str(error)) from error
            raise

    def _stored(self, stream: _Stream, row: Row) -> tuple[_Channel, RawMessage, memoryview | None]:
        """The data of a message and of its companion, and the channel that holds it."""
        _, owner, chunk, offset, time, companion_chunk, companion_offset, _ = row
        channel = stream.channels[owner]
        raw = self._file.read(channel.record.id, chunk, offset, time)
        if companion_chunk == NOWHERE or channel.companion is None:
            return channel, raw, None
        companion = self._file.read(channel.companion[0], companion_chunk, companion_offset, time)
        if companion.sequence != raw.sequence:
            raise self._unreadable(stream.info.name, raw, f"its companion is numbered {companion.sequence}")
        return channel, raw, companion.data

    def _rows(
        self, streams: list[_Stream], start: int | None, end: int | None, *, by_log_time: bool
    ) -> Iterator[tuple[_Stream, Row]]:
        """The merged sequence: always the stream whose next message has the smallest (stamp, stream)."""
        ordered = sorted(streams, key=lambda s: s.info.name)
        cursors = [rows(self._tracks(stream, by_log_time), start, end) for stream in ordered]
        return ((ordered[i], row) for i, row in merged(cursors))

    def _tracks(self, stream: _Stream, by_log_time: bool) -> Iterator[Track]:
        """The incarnations of a stream, one after the other, or all channels of a foreign one."""
        for group in [[c] for c in stream.channels] if stream.own else [stream.channels]:
            yield Track(
                entries=[c.entries for c in group],
                times=[c.entries.times if by_log_time else self._stamps(stream, c) for c in group],
                companions=[None if by_log_time else self._companions(stream, c) for c in group],
            )

    def _companions(
        self, stream: _Stream, channel: _Channel
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        if channel.companion is None:
            return None
        found = companions_of(channel.entries.times, channel.companion[1])
        if found is None:
            raise RecordingError(
                f"{self.path}: stream {stream.info.name!r} has companion messages of messages it lacks"
            )
        return found

    def _stamps(self, stream: _Stream, channel: _Channel) -> npt.NDArray[np.int64]:
        """The stamps of a channel by entry; those of foreign messages lie within them, so that takes one pass.

        Foreign messages of which two carry the same time are stamped with their log times instead.
        """
        if channel.stamps is None:
            count = len(channel.entries)
            decoded = (message.stamp for message in self._unordered(stream.info.name, channel))
            channel.stamps = np.fromiter(decoded, np.int64, count)
            if len(np.unique(channel.stamps)) < count:
                channel.stamps, channel.by_log_time = channel.entries.times, True
        return channel.stamps

    def _unordered(self, stream: str, channel: _Channel) -> Iterator[Message]:
        """The messages of a foreign channel in the order of its entries."""
        entries = channel.entries
        for i in range(len(entries)):
            place = int(entries.chunks[i]), int(entries.offsets[i]), int(entries.times[i])
            yield self._decode(stream, channel, self._file.read(channel.record.id, *place), None)

    def _decode(self, stream: str, channel: _Channel, raw: RawMessage, extra: memoryview | None) -> Message:
        try:
            if channel.decode is None:
                raise RecordingError(f"no decoder for {channel.record.message_encoding} of this schema")
            message = channel.decode(raw, extra)
            return message.replace(stamp=raw.log_time) if channel.by_log_time else message
        except (RecordingError, MessageError) as error:
            raise self._unreadable(stream, raw, str(error)) from error

    def _unreadable(self, stream: str, raw: RawMessage, why: str) -> RecordingError:
        return RecordingError(f"{self.path}: stream {stream!r}, message {raw.sequence} at {raw.log_time}: {why}")

    def _in_file_order(self, channels: list[int]) -> Iterator[RawMessage]:
        for place in in_file_order([(c, self._entries(c)) for c in channels]):
            yield self._file.read(*place)


def _key(channel: Channel, stream: str) -> tuple[str, str, str]:
    """What a channel and its companion have in common."""
    return stream, channel.metadata.get("incarnation", "0"), channel.metadata.get("sequence_base", "0")


def _number(text: str) -> int:
    return int(text) if text.isdecimal() else 0


def _merged(records: list[tuple[str, dict[str, str]]]) -> dict[str, dict[str, str]]:
    """Metadata by name; of one name and key the latest counts."""
    merged: dict[str, dict[str, str]] = {}
    for name, mapping in records:
        merged.setdefault(name, {}).update(mapping)
    return merged
