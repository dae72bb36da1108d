"""The MCAP container, writing side: records, compressed chunks and their indexes, safe against a kill and a full disk.

Schemas and channels are written at once, outside chunks, and messages are gathered into chunks; every chunk goes to the
operating system, with its message indexes, in one step. What is in the file at any moment is therefore readable.
Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import os
import struct
import time
import zlib
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from dataflow.recording.errors import RecordingError
from dataflow.recording.seals import sealed

Compression = Literal["zstd", "lz4", "none"]
Buffer = bytes | memoryview

MAGIC = b"\x89MCAP0\r\n"
ZSTD_LEVEL = 1
CHUNK_BYTES = 4 * 1024 * 1024
CHUNK_SECONDS = 1.0
MAX_CHANNELS = 65535
MAX_CHUNK_BYTES = 2**29
"""Uncompressed. Readers refuse more, so that a file made to do harm takes no more memory."""

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIXED = _MESSAGE.size - 9
_INDEX = struct.Struct("<BQHI")
_CHUNK = struct.Struct("<BQQQQI")


def record_bytes(record: McapRecord) -> bytes:
    """`record` as it lies in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _compressor(compression: Compression) -> Callable[[bytes], bytes]:
    match compression:
        case "zstd":
            return zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_checksum=False).compress
        case "lz4":
            return lambda data: bytes(lz4.frame.compress(data))
        case "none":
            return lambda data: data
    raise RecordingError(f"unknown compression {compression!r}; known: zstd, lz4, none")


@dataclass(slots=True)
class _Chunk:
    """The messages gathered since the last chunk was written."""

    since: float
    parts: list[Buffer] = field(default_factory=list)
    size: int = 0
    entries: dict[int, array[int]] = field(default_factory=dict)
    """By channel: log time and offset of each message, alternating."""
    first: int = 0
    last: int = 0

    def add(self, channel: int, log_time: int, sequence: int, parts: Sequence[Buffer]) -> None:
        length = _MESSAGE_FIXED + sum(len(part) for part in parts)
        self.first = log_time if not self.parts else min(self.first, log_time)
        self.last = max(self.last, log_time)
        self.parts.append(_MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_time, log_time))
        self.parts.extend(parts)
        self.entries.setdefault(channel, array("Q")).extend((log_time, self.size))
        self.size += length + 9

    @property
    def messages(self) -> int:
        return sum(len(entries) // 2 for entries in self.entries.values())


class ContainerWriter:
    """Writes one MCAP file. Not thread-safe.

    A chunk ends at `chunk_bytes` of messages, or when a message is added `chunk_seconds` after the chunk's first one.
    After a failed write the file is cut back to its last whole record, every later call raises the same
    `RecordingError`, and `close()` still adds the index if there is room for it.
    """

    def __init__(
        self,
        path: Path,
        *,
        library: str,
        compression: Compression = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
        chunk_seconds: float = CHUNK_SECONDS,
        overwrite: bool = False,
    ) -> None:
        self.path = path
        self._compress = _compressor(compression)
        self._compression = "" if compression == "none" else compression
        self._chunk_bytes, self._chunk_seconds = chunk_bytes, chunk_seconds
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: dict[int, int] = {}
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunk: _Chunk | None = None
        self.first_time: int | None = None
        self.last_time = 0
        self._failure: str | None = None
        self._position = 0
        self._fd = self._open(overwrite)
        try:
            self._append(MAGIC, sealed(record_bytes(Header(profile="", library=library))))
        except RecordingError:
            os.close(self._fd)
            raise

    def _open(self, overwrite: bool) -> int:
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (os.O_TRUNC if overwrite else os.O_EXCL)
        try:
            return os.open(self.path, flags, 0o666)
        except FileExistsError:
            raise RecordingError(f"{self.path} exists already; choose another name or ask to overwrite it") from None
        except OSError as error:
            raise RecordingError(f"cannot create the recording {self.path}: {error.strerror}") from error

    @property
    def closed(self) -> bool:
        return self._fd < 0

    @property
    def messages(self) -> int:
        """Messages added so far, those of the unfinished chunk included."""
        return sum(self._counts.values()) + (self._chunk.messages if self._chunk else 0)

    @property
    def saved_bytes(self) -> int:
        """Size of the file as it is now."""
        return self._position

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """The id of a schema; an equal one that is there already is used again."""
        for known in self._schemas:
            if (known.name, known.encoding, known.data) == (name, encoding, data):
                return known.id
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._append(sealed(record_bytes(schema)))
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
        self._append(sealed(record_bytes(channel)))
        self._channels.append(channel)
        self._counts[channel.id] = 0
        return channel.id

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        record = sealed(record_bytes(Metadata(name=name, metadata=dict(metadata))))
        offset = self._position
        self._append(record)
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def add_messages(self, group: Sequence[tuple[int, int, int, Sequence[Buffer]]]) -> None:
        """Adds messages, each (channel, log time, sequence, parts of its data), that must not be torn apart."""
        self._check_usable()
        now = time.monotonic()
        if self._chunk is not None and now - self._chunk.since >= self._chunk_seconds:
            self.finish_chunk()
        chunk = self._chunk = self._chunk or _Chunk(now)
        for channel, log_time, sequence, parts in group:
            chunk.add(channel, log_time, sequence, parts)
        if chunk.size >= self._chunk_bytes:
            self.finish_chunk()

    def finish_chunk(self) -> None:
        """Compresses the messages gathered so far and hands them to the operating system with their indexes."""
        self._check_usable()
        chunk = self._chunk
        if chunk is None:
            return
        raw = b"".join(chunk.parts)
        data = self._compress(raw)
        name = self._compression.encode()
        length = 32 + len(name) + 8 + len(data)
        head = (
            _CHUNK.pack(Opcode.CHUNK, length, chunk.first, chunk.last, len(raw), zlib.crc32(raw))
            + struct.pack("<I", len(name))
            + name
            + struct.pack("<Q", len(data))
        )
        start = self._position
        offset = start + len(head) + len(data)
        indexes: list[bytes] = []
        offsets: dict[int, int] = {}
        for channel, entries in chunk.entries.items():
            body = entries.tobytes()
            offsets[channel] = offset
            indexes.append(sealed(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(body), channel, len(body)) + body))
            offset += len(indexes[-1])
        self._append(head, data, *indexes)
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(head) + len(data),
                chunk_start_offset=start,
                compression=self._compression,
                compressed_size=len(data),
                message_end_time=chunk.last,
                message_index_length=sum(map(len, indexes)),
                message_index_offsets=offsets,
                message_start_time=chunk.first,
                uncompressed_size=len(raw),
            )
        )
        self.first_time = chunk.first if self.first_time is None else min(self.first_time, chunk.first)
        self.last_time = max(self.last_time, chunk.last)
        for channel, entries in chunk.entries.items():
            self._counts[channel] += len(entries) // 2
        self._chunk = None

    def close(self) -> None:
        """Finishes the last chunk and writes the index. Idempotent; the file is closed whatever happens."""
        if self.closed:
            return
        try:
            if self._failure is None:
                self.finish_chunk()
                self._append(self._ending())
            else:
                self._close_after_failure()
        finally:
            os.close(self._fd)
            self._fd = -1

    def _close_after_failure(self) -> None:
        """The end of a file whose last write failed: an index over what is there, if it fits."""
        failure, self._failure = self._failure, None
        with contextlib.suppress(RecordingError):  # without one, readers index the file by a pass over it
            self._append(self._ending())
        self._failure = failure

    def _check_usable(self) -> None:
        if self._failure is not None:
            raise RecordingError(self._failure)
        if self.closed:
            raise RecordingError(f"the recording {self.path} is closed")

    def _append(self, *parts: Buffer) -> None:
        """Writes all `parts` or, when the disk refuses, leaves the file as it was."""
        self._check_usable()
        try:
            written = 0
            for part in parts:
                view = memoryview(part)
                while view:
                    count = os.write(self._fd, view)
                    written += count
                    view = view[count:]
        except OSError as error:
            self._fail(error)
        self._position += written

    def _fail(self, error: OSError) -> None:
        saved = sum(c.uncompressed_size for c in self._chunks)
        cut = "it ends with its last whole chunk"
        try:
            os.ftruncate(self._fd, self._position)
            os.lseek(self._fd, self._position, os.SEEK_SET)
        except OSError as second:
            cut = f"its torn end could not be cut off ({second.strerror}), readers skip it"
        until = f", stamps up to {self.last_time}" if self._chunks else ""
        self._failure = (
            f"writing {self.path} failed: {error.strerror or error}. Saved: {self._position} bytes on disk, "
            f"{len(self._chunks)} chunks ({saved} bytes of messages{until}); the file is readable, {cut}. "
            f"The {self._chunk.messages if self._chunk else 0} messages since then are lost. "
            "Free some space or record to another disk."
        )
        raise RecordingError(self._failure) from error

    def _ending(self) -> bytes:
        """Data end, summary, footer and magic, as they follow at the current position."""
        data_end = record_bytes(DataEnd(data_section_crc=0))
        summary_start = self._position + len(data_end)
        groups: list[tuple[int, list[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas)),
            (Opcode.CHANNEL, list(self._channels)),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self._chunks)),
            (Opcode.METADATA_INDEX, list(self._metadata)),
        ]
        summary = bytearray()
        offsets = bytearray()
        for opcode, records in groups:
            start = len(summary)
            for record in records:
                summary += record_bytes(record)
            if records:
                offset = SummaryOffset(
                    group_opcode=opcode, group_start=summary_start + start, group_length=len(summary) - start
                )
                offsets += record_bytes(offset)
        start_field = summary_start if summary else 0
        offset_field = summary_start + len(summary) if offsets else 0
        body = bytes(summary + offsets)
        crc = zlib.crc32(body + struct.pack("<BQQQ", Opcode.FOOTER, 20, start_field, offset_field))
        footer = Footer(summary_start=start_field, summary_offset_start=offset_field, summary_crc=crc)
        return data_end + body + record_bytes(footer) + MAGIC

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={c: n for c, n in self._counts.items() if n},
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self.last_time,
            message_start_time=self.first_time or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
