"""The MCAP container, writing side: records, compressed chunks and their indexes, safe against a kill and a full disk.

Schemas, channels and metadata lie outside chunks, and messages are gathered into chunks: those of streams in
one, the run's records (firing records, events) in another, so that records can be read without the streams. All go to
the operating system, with the message indexes, in one step: first what lies outside chunks, then the records. The file
is therefore readable at any moment, and holds everything added up to some moment.
Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NoReturn

from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from dataflow.recording.errors import RecordingError
from dataflow.recording.limits import MAX_CHANNELS, MAX_CHUNK_BYTES, MAX_CHUNK_MESSAGES, MAX_PARSED, MAX_RECORD_BYTES
from dataflow.recording.mcap.attachments import Attachment
from dataflow.recording.mcap.ending import MAGIC, KeptIndexes, ending, record_bytes
from dataflow.recording.mcap.packing import Buffer, Compression, Packer, PendingChunk, message_size
from dataflow.recording.mcap.seals import sealed
from dataflow.recording.parts import OWNER_ONLY, created

CHUNK_BYTES = 4 * 1024 * 1024
CHUNK_SECONDS = 1.0
WRITE_BYTES = 64 * 1024
"""Parts up to this size are joined for a write."""


class ContainerWriter:
    """Writes one MCAP file. Not thread-safe.

    Chunks end when one has `chunk_bytes` of messages, or when one is added `chunk_seconds` after the first one.
    After a failed write the file is cut back to its last whole record, every later call raises the same
    `RecordingError`, and `close()` still adds the index if there is room for it.
    """

    def __init__(
        self,
        path: Path,
        *,
        library: str,
        profile: str = "",
        compression: Compression = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
        chunk_seconds: float = CHUNK_SECONDS,
        overwrite: bool = False,
        mode: int = OWNER_ONLY,
    ) -> None:
        self.path = path
        self._packer = Packer(compression)
        self._chunk_bytes, self._chunk_seconds = min(chunk_bytes, MAX_CHUNK_BYTES), chunk_seconds
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: dict[int, int] = {}
        self._chunks = KeptIndexes()
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._declared: list[bytes] = []
        """Schemas, channels and metadata that go to the disk with the next chunk, or at a flush."""
        self._lasting = 0, 0, 0
        """Numbers of schemas, channels and metadata in the file."""
        self._open: dict[Literal["record", "message"], PendingChunk] = {}
        """The chunks in progress."""
        self.first_time: int | None = None
        self.last_time = 0
        self._failure: str | None = None
        self._position = 0
        self._fd = created(path, overwrite, mode)
        try:
            self._append(MAGIC, sealed(record_bytes(Header(profile=profile, library=library))))
        except RecordingError:
            os.close(self._fd)
            raise

    @property
    def closed(self) -> bool:
        return self._fd < 0

    def saved(self, topic: str) -> int:
        """Messages of a topic that are in the file now."""
        return sum(self._counts[channel.id] for channel in self._channels if channel.topic == topic)

    @property
    def failed(self) -> bool:
        """Returns whether a write has failed, so that nothing more can be added."""
        return self._failure is not None

    @property
    def saved_bytes(self) -> int:
        """Size of the file as it is now."""
        return self._position

    @property
    def given_bytes(self) -> int:
        """Size of the file with all that waits to be written, before it is compressed."""
        return self._position + self._declared_bytes + sum(chunk.size for chunk in self._gathered())

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """The id of a schema; an equal one that is there already is used again."""
        for known in self._schemas:
            if (known.name, known.encoding, known.data) == (name, encoding, data):
                return known.id
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._declare(self._checked("schema", name, schema))
        self._schemas.append(schema)
        return schema.id

    def add_channel(self, topic: str, message_encoding: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        """The id of a new channel."""
        if len(self._channels) >= MAX_CHANNELS:
            raise RecordingError(f"{self.path}: an MCAP file holds at most {MAX_CHANNELS} channels")
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=message_encoding,
            schema_id=schema_id,
            metadata=dict(metadata),
        )
        self._declare(self._checked("channel", topic, channel))
        self._channels.append(channel)
        self._counts[channel.id] = 0
        return channel.id

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        record = self._checked("metadata", name, Metadata(name=name, metadata=dict(metadata)))
        offset = self._declare(record)
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def add_attachment(self, attachment: Attachment) -> None:
        """Adds a file inside this one; its record has a separate checksum."""
        self._count_parsed()
        made = AttachmentRecord(
            attachment.created, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
        record = record_bytes(made)
        if len(record) > MAX_CHUNK_BYTES:
            self._refuse(f"attachment {attachment.name!r}", len(record), MAX_CHUNK_BYTES)
        offset = self._position + self._declared_bytes
        self._append(record)
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=made.log_time,
                create_time=made.create_time,
                data_size=len(made.data),
                name=made.name,
                media_type=made.media_type,
            )
        )

    def add_messages(self, group: Sequence[tuple[int, int, int, Sequence[Buffer]]]) -> None:
        """Adds messages, each (channel, log time, sequence, parts of its data), that must not be torn apart.

        Raises `RecordingError` for a group larger than a chunk that readers take.
        """
        self._gather("message", group)

    def add_record(self, channel: int, log_time: int, sequence: int, data: bytes) -> None:
        """Adds a record of the run, which lies apart from the messages of streams."""
        self._gather("record", [(channel, log_time, sequence, [data])])

    def add_copied(self, channel: int, log_time: int, publish_time: int, sequence: int, data: Buffer) -> None:
        """Adds a message of another file as it is there."""
        self._gather("message", [(channel, log_time, sequence, [data])], publish_time)

    def _gather(
        self,
        kind: Literal["record", "message"],
        group: Sequence[tuple[int, int, int, Sequence[Buffer]]],
        published: int | None = None,
    ) -> None:
        size = sum(message_size(parts) for _, _, _, parts in group)
        if size > MAX_CHUNK_BYTES:
            self._refuse(f"a {kind}", size, MAX_CHUNK_BYTES)
        now = self._begin(self._open[kind].size + size if kind in self._open else 0)
        chunk = self._open.get(kind)
        if chunk is None:
            chunk = self._open[kind] = PendingChunk(now)
        for channel, log_time, sequence, parts in group:
            chunk.add(channel, log_time, sequence, parts, published)
        if chunk.size >= self._chunk_bytes or chunk.messages >= MAX_CHUNK_MESSAGES:
            self.finish_chunks()

    def _checked(self, what: str, name: str, record: McapRecord) -> bytes:
        """A record as it will lie in the file. Raises `RecordingError` for one that readers refuse."""
        self._count_parsed()
        data = sealed(record_bytes(record))
        if len(data) > MAX_RECORD_BYTES:
            self._refuse(f"{what} {name!r}", len(data), MAX_RECORD_BYTES)
        return data

    def _count_parsed(self) -> None:
        count = len(self._schemas) + len(self._channels) + len(self._metadata) + len(self._attachments)
        if count >= MAX_PARSED:
            raise RecordingError(
                f"{self.path}: a recording holds at most {MAX_PARSED} schemas, channels, metadata and attachments"
            )

    def _refuse(self, what: str, size: int, most: int) -> NoReturn:
        raise RecordingError(f"{self.path}: {what} of {size} bytes; at most {most} are recorded")

    def _begin(self, size: int) -> float:
        """The time now, after the chunks are finished that are old, or would become larger than readers take."""
        self._check_usable()
        now = time.monotonic()
        oldest = min((chunk.since for chunk in self._gathered()), default=now)
        if now - oldest >= self._chunk_seconds or size > MAX_CHUNK_BYTES:
            self.finish_chunks()
        return now

    def finish_chunks(self) -> None:
        """Compresses what was gathered so far and hands it to the operating system, with all that was declared."""
        self._check_usable()
        gathered = self._gathered()
        parts: list[bytes] = []
        indexes: list[ChunkIndex] = []
        position = self._position + self._declared_bytes
        for chunk in gathered:
            packed, index = self._packer.pack(chunk, position)
            parts += packed
            indexes.append(index)
            position += index.chunk_length + index.message_index_length
        self._append(*parts)
        self._chunks.add(indexes)
        for chunk in gathered:
            self.first_time = chunk.first if self.first_time is None else min(self.first_time, chunk.first)
            self.last_time = max(self.last_time, chunk.last)
            for channel, count in chunk.counts.items():
                self._counts[channel] += count
        self._open.clear()

    def _gathered(self) -> list[PendingChunk]:
        """The chunks in progress, in the order in which they are written."""
        return [self._open[kind] for kind in ("record", "message") if kind in self._open]

    def _unsaved(self) -> int:
        """Messages and records in chunks in progress."""
        return sum(sum(chunk.counts.values()) for chunk in self._gathered())

    def close(self) -> None:
        """Finishes the last chunk and writes the index. Idempotent; the file is closed whatever happens."""
        if self.closed:
            return
        try:
            if self._failure is None:
                self.finish_chunks()
                self._write(self._ending())
            else:
                failure, self._failure = self._failure, None
                with contextlib.suppress(RecordingError):  # without an index, readers make one by a pass over the file
                    self._write(self._ending())
                self._failure = failure
        finally:
            os.close(self._fd)
            self._fd = -1

    def _check_usable(self) -> None:
        if self._failure is not None:
            raise RecordingError(self._failure)
        if self.closed:
            raise RecordingError(f"the recording {self.path} is closed")

    @property
    def _declared_bytes(self) -> int:
        return sum(map(len, self._declared))

    def _declare(self, record: bytes) -> int:
        """Adds a record outside chunks, which waits for the next write; returns its offset in the file."""
        self._check_usable()
        if self._declared_bytes >= WRITE_BYTES:
            self._append()
        offset = self._position + self._declared_bytes
        self._declared.append(record)
        return offset

    def _append(self, *parts: Buffer) -> None:
        self._write([*self._declared, *parts])
        self._declared.clear()
        self._lasting = len(self._schemas), len(self._channels), len(self._metadata)

    def _write(self, parts: Iterable[Buffer]) -> None:
        """Writes all `parts` or, when the disk refuses, leaves the file as it was."""
        self._check_usable()
        try:
            written = 0
            for part in _together(parts):
                view = memoryview(part)
                while view:
                    count = os.write(self._fd, view)
                    written += count
                    view = view[count:]
        except OSError as error:
            self._fail(error)
        self._position += written

    def _fail(self, error: OSError) -> None:
        cut = "it ends with its last whole chunk"
        try:
            os.ftruncate(self._fd, self._position)
            os.lseek(self._fd, self._position, os.SEEK_SET)
        except OSError as second:
            cut = f"its torn end could not be cut off ({second.strerror}), readers skip it"
        until = f", stamps up to {self.last_time}" if self._chunks.count else ""
        self._declared.clear()
        schemas, channels, metadata = self._lasting
        del self._schemas[schemas:], self._channels[channels:], self._metadata[metadata:]
        self._failure = (
            f"writing {self.path} failed: {error.strerror or error}. Saved: {self._position} bytes on disk, "
            f"{self._chunks.count} chunks ({self._chunks.content_bytes} bytes of messages{until}); "
            f"the file is readable, {cut}. The {self._unsaved()} messages since then are lost. "
            "Free some space or record to another disk."
        )
        raise RecordingError(self._failure) from error

    def _ending(self) -> Iterator[bytes]:
        return ending(
            self._position,
            {
                Opcode.SCHEMA: map(record_bytes, self._schemas),
                Opcode.CHANNEL: map(record_bytes, self._channels),
                Opcode.STATISTICS: [record_bytes(self._statistics())],
                Opcode.CHUNK_INDEX: self._chunks.records(),
                Opcode.ATTACHMENT_INDEX: map(record_bytes, self._attachments),
                Opcode.METADATA_INDEX: map(record_bytes, self._metadata),
            },
        )

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={c: n for c, n in self._counts.items() if n},
            chunk_count=self._chunks.count,
            message_count=sum(self._counts.values()),
            message_end_time=self.last_time,
            message_start_time=self.first_time or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _together(parts: Iterable[Buffer]) -> Iterator[Buffer | bytearray]:
    """The parts, small ones joined: a disk may take its time for each write."""
    small = bytearray()
    for part in parts:
        if small and len(small) + len(part) > WRITE_BYTES:
            yield small
            small = bytearray()
        if len(part) > WRITE_BYTES:
            yield part
        else:
            small += part
    if small:
        yield small
