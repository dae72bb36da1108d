"""Streams of a recording: what is known of each from its channels, and how its messages are decoded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mcap.records import Channel

from dataflow.messages.base import Message, MessageError, message_types, registered_type
from dataflow.messages.declaration import Declaration, GenericMessage, known_type
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import Kind
from dataflow.recording.mcap.contents import Entries
from dataflow.recording.mcap.index import McapFile, RawMessage
from dataflow.recording.mcap.message_index import MessageIndex
from dataflow.recording.streams.codecs import SchemaText, codec_for, declaration_digest, recorded_declaration
from dataflow.recording.streams.foreign import foreign_decoder
from dataflow.recording.streams.part_folder import PartedFile


@dataclass(slots=True)
class UnreadableMessages:
    """Messages that cannot be read and were passed over: how many, and what is wrong with the first."""

    count: int
    reason: str

    def __str__(self) -> str:
        messages = f"{self.count:,} message{'' if self.count == 1 else 's'}"
        return f"{messages} that cannot be read passed over, the first: {self.reason}"


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """Facts about one stream, known without decoding it.

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
        """Returns whether its messages are read by the recording's declaration, without the class that made them."""
        found = self.message_type
        return found is not None and issubclass(found, GenericMessage)

    @property
    def declared_otherwise(self) -> bool:
        """Returns whether the type's declaration in this program differs from the one that the messages were written
        with."""
        if self.declaration is not None:
            return self.generic and registered_type(self.declaration.schema) is not None
        written = self.metadata.get("declaration", "")
        return self.metadata.get("kind") == Kind.STREAM and (
            self.known is not None and written != declaration_digest(self.known)
        )


Decode = Callable[[RawMessage, memoryview | None], Message]
File = McapFile | PartedFile
"""A recording in one file or in parts."""
PEEKED = 64
"""Messages of a foreign stream, evenly spaced, among which its type is looked for."""
TypeOf = Callable[[], type[Message] | None]


@dataclass(slots=True)
class StreamChannel:
    """One MCAP channel of a stream: an incarnation, or a part of one."""

    record: Channel
    incarnation: int
    base: int
    index: MessageIndex
    companion: int | None
    """Id of the companion."""
    decode: Decode | None
    readable: Entries | None = None
    """Those of a foreign channel's messages that can be read, and
    `stamps`, theirs: only known after a pass."""
    stamps: npt.NDArray[np.int64] | None = None
    by_log_time: bool = False
    """Foreign messages whose own times are not usable."""

    @property
    def count(self) -> int:
        """Messages of the channel."""
        return self.index.count(self.record.id)

    def count_from(self, start: int | None) -> int:
        """Messages with log times from `start` (ns) on."""
        if start is None:
            return self.count
        return sum(int((part.times >= start).sum()) for part in self.index.blocks(self.record.id, start, None))

    @property
    def span(self) -> tuple[int, int] | None:
        """The smallest and the largest log time (ns); None where there is no message."""
        return self.index.span(self.record.id)

    @property
    def entries(self) -> Entries:
        """All messages of the channel."""
        return self.index.entries(self.record.id)


@dataclass(slots=True)
class IndexedStream:
    """A stream with its channels, in the order of its messages."""

    info: StreamInfo
    own: bool
    channels: list[StreamChannel] = field(default_factory=list)
    unread: UnreadableMessages | None = None

    def pass_over(self, count: int, reason: str) -> None:
        """Notes messages that cannot be read; of several passes the one that found most counts."""
        known = self.unread or UnreadableMessages(0, reason)
        self.unread = UnreadableMessages(max(known.count, count), known.reason)


class StreamFinder:
    """Finds the streams of a file by its channels, without decoding messages other than one of each foreign stream."""

    def __init__(self, file: File) -> None:
        self._file = file

    def all(self) -> dict[str, IndexedStream]:
        """Returns the streams by name."""
        sizes = self._file.message_bytes()
        grouped: dict[str, list[Channel]] = {}
        companions: dict[tuple[str, str, str], Channel] = {}
        for channel in self._file.channels.values():
            kind = channel.metadata.get("kind")
            if kind == Kind.COMPANION:
                companions[_key(channel, channel.metadata.get("companion_of", ""))] = channel
            elif kind not in (Kind.FIRINGS, Kind.EVENTS, Kind.FRAMES):
                grouped.setdefault(channel.topic, []).append(channel)
        found = {name: self._one(name, channels, companions, sizes) for name, channels in grouped.items()}
        return dict(sorted(found.items()))

    def _one(
        self,
        name: str,
        records: list[Channel],
        companions: Mapping[tuple[str, str, str], Channel],
        sizes: Mapping[int, int],
    ) -> IndexedStream:
        first = records[0]
        own = first.metadata.get("kind") == Kind.STREAM
        declaration = recorded_declaration(first.metadata) if own else None
        known = message_types().get(first.metadata.get("message_type", "")) if own else None
        read_as: TypeOf = (lambda: known) if declaration is None else partial(known_type, declaration)
        channels: list[StreamChannel] = []
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
        spans = [span for c in channels if (span := c.span) is not None]
        schema = self._schema(first)
        info = StreamInfo(
            name=name,
            schema=schema.name,
            encoding=first.message_encoding,
            declaration=declaration,
            known=known,
            count=sum(c.count for c in channels),
            first=min((first for first, _ in spans), default=None),
            last=max((last for _, last in spans), default=None),
            static=first.metadata.get("static") == "true" and own,
            bytes=size,
            incarnations=len({c.incarnation for c in channels if c.count}),
            metadata=first.metadata,
        )
        return IndexedStream(info, own, channels)

    def _own_channel(self, record: Channel, companion: Channel | None, read_as: TypeOf) -> StreamChannel:
        def decode(raw: RawMessage, extra: memoryview | None) -> Message:
            message_type = read_as()
            assert message_type is not None
            return codec_for(message_type).decode(raw.log_time, raw.data, extra)

        return StreamChannel(
            record,
            incarnation=_number(record.metadata.get("incarnation", "0")),
            base=_number(record.metadata.get("sequence_base", "0")),
            index=self._file.index,
            companion=None if companion is None else companion.id,
            decode=None if read_as() is None else decode,
        )

    def _foreign_channel(self, record: Channel) -> StreamChannel:
        decoder = foreign_decoder(record.message_encoding, self._schema(record))

        def decode(raw: RawMessage, extra: memoryview | None) -> Message:
            assert decoder is not None
            return decoder(bytes(raw.data), raw.log_time)

        return StreamChannel(record, 0, 0, self._file.index, None, None if decoder is None else decode)

    def _peek(self, name: str, channels: list[StreamChannel]) -> type[Message] | None:
        """The type of a foreign stream's first message that can be read, as far as it is looked for; None when none
        can."""
        for channel in channels:
            if channel.decode is None or not channel.count:
                continue
            entries = channel.entries
            for at in np.unique(np.linspace(0, len(entries) - 1, PEEKED).astype(np.int64)).tolist():
                with suppress(RecordingError):
                    return type(message_at(self._file, name, channel, entries, at))
            channel.decode = None
        return None

    def _schema(self, channel: Channel) -> SchemaText:
        schema = self._file.schemas.get(channel.schema_id)
        return SchemaText("", "", b"") if schema is None else SchemaText(schema.name, schema.encoding, schema.data)


def message_at(file: File, stream: str, channel: StreamChannel, entries: Entries, at: int) -> Message:
    """One message of a foreign channel, by its entry. Raises `RecordingError`."""
    place = int(entries.chunks[at]), int(entries.offsets[at]), int(entries.times[at])
    return decoded(file.path, stream, channel, file.read(channel.record.id, *place), None)


def decoded(path: Path, stream: str, channel: StreamChannel, raw: RawMessage, extra: memoryview | None) -> Message:
    """Returns a message as its type. Raises `RecordingError`."""
    try:
        if channel.decode is None:
            raise RecordingError(f"no decoder for {channel.record.message_encoding} of this schema")
        message = channel.decode(raw, extra)
        return message.replace(stamp=raw.log_time) if channel.by_log_time else message
    except (RecordingError, MessageError) as error:
        raise unreadable(path, stream, raw, str(error)) from error


def unreadable(path: Path, stream: str, raw: RawMessage, why: str) -> RecordingError:
    return RecordingError(f"{path}: stream {stream!r}, message {raw.sequence} at {raw.log_time}: {why}")


def _key(channel: Channel, stream: str) -> tuple[str, str, str]:
    """Returns what a channel and its companion have in common."""
    return stream, channel.metadata.get("incarnation", "0"), channel.metadata.get("sequence_base", "0")


def _number(text: str) -> int:
    return int(text) if text.isdecimal() else 0
