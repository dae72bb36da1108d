"""Chunks of an MCAP file on their way into it: gathered message by message, then packed with their indexes.

Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from dataflow.recording.errors import RecordingError
from dataflow.recording.mcap.seals import sealed

Compression = Literal["zstd", "lz4", "none"]
Buffer = bytes | memoryview

ZSTD_LEVEL = 1
_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<BQHI")
_CHUNK = struct.Struct("<BQQQQI")


def message_size(parts: Sequence[Buffer]) -> int:
    """Bytes that a message of these parts takes in a chunk."""
    return _MESSAGE.size + sum(len(part) for part in parts)


@dataclass(slots=True)
class PendingChunk:
    """Messages for one chunk, since the time (s, monotonic) of the first one."""

    since: float
    parts: list[Buffer] = field(default_factory=list)
    size: int = 0
    messages: int = 0
    entries: dict[int, array[int]] = field(default_factory=dict)
    """By channel: log time and offset of each message, alternating."""
    first: int = 0
    last: int = 0

    def add(
        self, channel: int, log_time: int, sequence: int, parts: Sequence[Buffer], publish_time: int | None = None
    ) -> None:
        size = message_size(parts)
        published = log_time if publish_time is None else publish_time
        self.first = log_time if not self.parts else min(self.first, log_time)
        self.last = max(self.last, log_time)
        self.parts.append(_MESSAGE.pack(Opcode.MESSAGE, size - 9, channel, sequence, log_time, published))
        self.parts.extend(parts)
        self.entries.setdefault(channel, array("Q")).extend((log_time, self.size))
        self.size += size
        self.messages += 1

    @property
    def counts(self) -> dict[int, int]:
        """Messages by channel."""
        return {channel: len(entries) // 2 for channel, entries in self.entries.items()}


class Packer:
    """Compresses chunks."""

    def __init__(self, compression: Compression) -> None:
        self._compress = _compressor(compression)
        self._name = "" if compression == "none" else compression

    def pack(self, chunk: PendingChunk, position: int) -> tuple[list[bytes], ChunkIndex]:
        """A chunk and its message indexes as they lie in the file from `position`, and its entry in the index."""
        raw = b"".join(chunk.parts)
        data = self._compress(raw)
        name = self._name.encode()
        length = 32 + len(name) + 8 + len(data)
        head = (
            _CHUNK.pack(Opcode.CHUNK, length, chunk.first, chunk.last, len(raw), zlib.crc32(raw))
            + struct.pack("<I", len(name))
            + name
            + struct.pack("<Q", len(data))
        )
        offset = position + len(head) + len(data)
        indexes: list[bytes] = []
        offsets: dict[int, int] = {}
        for channel, entries in chunk.entries.items():
            body = entries.tobytes()
            offsets[channel] = offset
            indexes.append(sealed(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(body), channel, len(body)) + body))
            offset += len(indexes[-1])
        index = ChunkIndex(
            chunk_length=len(head) + len(data),
            chunk_start_offset=position,
            compression=self._name,
            compressed_size=len(data),
            message_end_time=chunk.last,
            message_index_length=sum(map(len, indexes)),
            message_index_offsets=offsets,
            message_start_time=chunk.first,
            uncompressed_size=len(raw),
        )
        return [head, data, *indexes], index


def _compressor(compression: Compression) -> Callable[[bytes], bytes]:
    match compression:
        case "zstd":
            return zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_checksum=False).compress
        case "lz4":
            return lambda data: bytes(lz4.frame.compress(data))
        case "none":
            return lambda data: data
    raise RecordingError(f"unknown compression {compression!r}; known: zstd, lz4, none")
