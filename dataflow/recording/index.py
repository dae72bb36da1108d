"""Where every message of an MCAP file lies, from its index or, for torn and foreign files without one, by a pass.

The index takes 24 bytes of memory a message, whatever the messages hold.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from array import array
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Metadata, MetadataIndex, Schema

from dataflow.recording.container import MAGIC
from dataflow.recording.errors import RecordingError

FOOTER_BYTES = 9 + 20
UNCHUNKED = -1
MAX_CHUNK_BYTES = 2**30
CACHE_BYTES = 256 * 2**20

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_BODY = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """One chunk: where its record's body begins in the file, and what the index says of it."""

    offset: int
    length: int
    uncompressed_size: int


@dataclass(frozen=True, slots=True)
class Entries:
    """The messages of one channel in file order: log time (ns), chunk number or UNCHUNKED, offset in it or the file."""

    times: npt.NDArray[np.int64]
    chunks: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message record as it stands in the file. `data` is a view of its chunk."""

    channel: int
    sequence: int
    log_time: int
    data: memoryview


@dataclass(slots=True)
class _Growing:
    times: array[int] = field(default_factory=lambda: array("q"))
    chunks: array[int] = field(default_factory=lambda: array("q"))
    offsets: array[int] = field(default_factory=lambda: array("q"))

    def add(self, time: int, chunk: int, offset: int) -> None:
        self.times.append(time)
        self.chunks.append(chunk)
        self.offsets.append(offset)

    def extend(self, entries: npt.NDArray[Any], chunk: int) -> None:
        self.times.frombytes(entries["time"].astype("<i8").tobytes())
        self.offsets.frombytes(entries["offset"].astype("<i8").tobytes())
        self.chunks.extend([chunk] * len(entries))

    def done(self) -> Entries:
        columns = (np.frombuffer(c, np.int64) if len(c) else np.empty(0, np.int64) for c in self._columns())
        return Entries(*columns)

    def _columns(self) -> tuple[array[int], array[int], array[int]]:
        return self.times, self.chunks, self.offsets


class McapFile:
    """Random access to the messages of an MCAP file.

    `torn`: the file has no proper end; it holds what was written up to its last whole chunk. Raises `RecordingError`
    for a file that is no MCAP or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header = Header("", "")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkRef] = []
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.torn = False
        self.lost_bytes = 0
        self._growing: dict[int, _Growing] = {}
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        self._cached_bytes = 0
        self._decompressor = zstandard.ZstdDecompressor()
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise RecordingError(f"cannot open the recording {path}: {error.strerror}") from error
        try:
            self._load()
        except struct.error as error:
            self.close()
            raise self._damaged(f"a record is too short: {error}") from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Closes the file. Idempotent."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        self._cache.clear()

    def read(self, chunk: int, offset: int) -> RawMessage:
        """The message that an entry of the index points to."""
        data = memoryview(self._chunk(chunk)) if chunk != UNCHUNKED else self._unchunked(offset)
        start = offset if chunk != UNCHUNKED else 0
        if start < 0 or start + _MESSAGE.size > len(data):
            raise self._damaged(f"an index entry points to byte {offset}, outside chunk {chunk}")
        opcode, length, channel, sequence, log_time, _ = _MESSAGE.unpack_from(data, start)
        end = start + _RECORD.size + length
        if opcode != Opcode.MESSAGE or length < _MESSAGE_BODY.size or end > len(data):
            raise self._damaged(f"an index entry points to byte {offset} of chunk {chunk}, where no message is")
        return RawMessage(channel, sequence, log_time, data[start + _MESSAGE.size : end])

    def message_bytes(self) -> dict[int, int]:
        """Bytes of message data by channel, before compression. Exact where chunks hold nothing but messages."""
        known = [(c, e) for c, e in self.entries.items() if len(e)]
        if not known:
            return {}
        owner = np.concatenate([np.full(len(e), c, np.int64) for c, e in known])
        chunks = np.concatenate([e.chunks for _, e in known])
        offsets = np.concatenate([e.offsets for _, e in known])
        order = np.lexsort((offsets, chunks))
        owner, chunks, offsets = owner[order], chunks[order], offsets[order]
        ends = np.empty_like(offsets)
        ends[:-1] = offsets[1:]
        last = np.ones(len(chunks), bool)
        last[:-1] = chunks[1:] != chunks[:-1]
        limits = np.array(
            [min(c.uncompressed_size, MAX_CHUNK_BYTES) for c in self.chunks] + [0], np.int64
        )  # UNCHUNKED is the last
        ends[last] = limits[chunks[last]]
        sizes = np.maximum(ends - offsets - _MESSAGE.size, 0)
        for i in np.flatnonzero(chunks == UNCHUNKED):
            sizes[i] = len(self.read(UNCHUNKED, int(offsets[i])).data)
        totals = np.bincount(owner, weights=sizes)
        return {c: int(totals[c]) for c, _ in known}

    # ------------------------------------------------------------------------------------------------- loading

    def _load(self) -> None:
        self._size = os.fstat(self._fd).st_size
        if self._pread(0, len(MAGIC), allow_short=True) != MAGIC:
            raise RecordingError(f"{self.path} is not an MCAP file: it does not begin with the MCAP magic bytes")
        self._load_header()
        summary_start = self._summary_start()
        if summary_start is None or not self._load_summary(summary_start):
            self.schemas.clear()
            self.channels.clear()
            self.chunks.clear()
            self.metadata.clear()
            self._growing.clear()
            self._scan()
        self.entries = {channel: growing.done() for channel, growing in self._growing.items()}
        self._growing = {}
        unknown = self.entries.keys() - self.channels.keys()
        if unknown:
            raise self._damaged(f"it holds messages of channels that it does not declare: {sorted(unknown)}")

    def _load_header(self) -> None:
        head = self._pread(len(MAGIC), _RECORD.size, allow_short=True)
        if len(head) < _RECORD.size:
            return
        opcode, length = _RECORD.unpack(head)
        start = len(MAGIC) + _RECORD.size
        if opcode == Opcode.HEADER and start + length <= self._size:
            self.header = self._parse(Header, self._pread(start, length))

    def _summary_start(self) -> int | None:
        """Where the summary begins, or None when there is none; sets `torn` when the file has no proper end."""
        tail = FOOTER_BYTES + len(MAGIC)
        if self._size < len(MAGIC) + tail:
            self.torn = True
            return None
        data = self._pread(self._size - tail, tail)
        if data[FOOTER_BYTES:] != MAGIC or data[0] != Opcode.FOOTER:
            self.torn = True
            return None
        (start,) = struct.unpack_from("<Q", data, _RECORD.size)
        if start == 0:
            return None
        if not len(MAGIC) <= start <= self._size - tail:
            raise self._damaged(f"its footer puts the summary at byte {start} of {self._size}")
        return int(start)

    def _load_summary(self, start: int) -> bool:
        """Takes everything from the summary. False when that is not enough to find every message."""
        data = self._pread(start, self._size - start - FOOTER_BYTES - len(MAGIC))
        indexes: list[ChunkIndex] = []
        metadata: list[MetadataIndex] = []
        messages: int | None = None
        position = 0
        while position + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, position)
            body = data[position + _RECORD.size : position + _RECORD.size + length]
            if len(body) != length:
                raise self._damaged("its summary ends within a record")
            match opcode:
                case Opcode.SCHEMA | Opcode.CHANNEL:
                    self._declare(opcode, body)
                case Opcode.CHUNK_INDEX:
                    indexes.append(self._parse(ChunkIndex, body))
                case Opcode.METADATA_INDEX:
                    metadata.append(self._parse(MetadataIndex, body))
                case Opcode.STATISTICS:
                    (messages,) = struct.unpack_from("<Q", body)
            position += _RECORD.size + length
        for entry in metadata:
            self._add_metadata(self._pread(entry.offset + _RECORD.size, entry.length - _RECORD.size))
        for index in sorted(indexes, key=lambda i: i.chunk_start_offset):
            if not index.message_index_offsets:
                return False
            self._load_chunk_index(index)
        return (bool(indexes) or messages == 0) and self._growing.keys() <= self.channels.keys()

    def _load_chunk_index(self, index: ChunkIndex) -> None:
        number = len(self.chunks)
        start = index.chunk_start_offset + _RECORD.size
        self.chunks.append(ChunkRef(start, index.chunk_length - _RECORD.size, index.uncompressed_size))
        first = min(index.message_index_offsets.values())
        data = self._pread(first, index.message_index_length)
        for offset in index.message_index_offsets.values():
            at = offset - first
            if at < 0 or at + _RECORD.size > len(data) or data[at] != Opcode.MESSAGE_INDEX:
                raise self._damaged(f"its index puts a message index at byte {offset}, where none is")
            (length,) = struct.unpack_from("<Q", data, at + 1)
            self._add_message_index(data[at + _RECORD.size : at + _RECORD.size + length], number)

    def _scan(self) -> None:
        """The index by a pass over the records of the file, up to the last whole one."""
        position = len(MAGIC)
        pending: tuple[ChunkRef, list[bytes]] | None = None
        while position + _RECORD.size <= self._size:
            opcode, length = _RECORD.unpack(self._pread(position, _RECORD.size))
            start = position + _RECORD.size
            if start + length > self._size or opcode == 0:
                break
            if opcode == Opcode.MESSAGE_INDEX and pending is not None:
                pending[1].append(self._pread(start, length))
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                break
            else:
                if pending is not None:
                    self._take_chunk(*pending)
                    pending = None
                match opcode:
                    case Opcode.SCHEMA | Opcode.CHANNEL:
                        self._declare(opcode, self._pread(start, length))
                    case Opcode.METADATA:
                        self._add_metadata(self._pread(start, length))
                    case Opcode.MESSAGE:
                        channel, _, log_time, _ = _MESSAGE_BODY.unpack(self._pread(start, _MESSAGE_BODY.size))
                        self._channel_entries(channel).add(_signed(log_time), UNCHUNKED, position)
                    case Opcode.CHUNK:
                        head = self._pread(start, min(_CHUNK.size, length))
                        if len(head) < _CHUNK.size:
                            raise self._damaged(f"the chunk at byte {position} is too short")
                        pending = (ChunkRef(start, length, _CHUNK.unpack(head)[2]), [])
            position = start + length
        if pending is not None:  # its message indexes may be torn
            self._take_chunk(pending[0], [])
        if self.torn:
            self.lost_bytes = self._size - position

    def _take_chunk(self, chunk: ChunkRef, indexes: list[bytes]) -> None:
        """Adds a chunk found by the pass: by its message indexes, or by reading it where they do not suffice."""
        number = len(self.chunks)
        self.chunks.append(chunk)
        if indexes and all(struct.unpack_from("<H", body)[0] in self.channels for body in indexes):
            for body in indexes:
                self._add_message_index(body, number)
            return
        data = self._chunk(number)
        position = 0
        while position + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, position)
            start = position + _RECORD.size
            if start + length > len(data):
                raise self._damaged(f"chunk {number} ends within a record")
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._declare(opcode, data[start : start + length])
            elif opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = _MESSAGE_BODY.unpack_from(data, start)
                self._channel_entries(channel).add(_signed(log_time), number, position)
            position = start + length

    def _declare(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = self._parse(Schema, body)
            self.schemas[schema.id] = schema
        else:
            channel = self._parse(Channel, body)
            self.channels[channel.id] = channel

    def _add_metadata(self, body: bytes) -> None:
        record = self._parse(Metadata, body)
        self.metadata.append((record.name, record.metadata))

    def _add_message_index(self, body: bytes, chunk: int) -> None:
        channel, length = struct.unpack_from("<HI", body)
        if length % _ENTRY.itemsize or 6 + length > len(body):
            raise self._damaged(f"a message index of chunk {chunk} has an impossible length")
        self._channel_entries(channel).extend(np.frombuffer(body, _ENTRY, length // _ENTRY.itemsize, 6), chunk)

    def _channel_entries(self, channel: int) -> _Growing:
        return self._growing.setdefault(channel, _Growing())

    # ------------------------------------------------------------------------------------------------- reading

    def _chunk(self, number: int) -> bytes:
        """The records of a chunk, decompressed; the newest ones stay in memory."""
        cached = self._cache.get(number)
        if cached is not None:
            self._cache.move_to_end(number)
            return cached
        data = self._decompress(number)
        self._cache[number] = data
        self._cached_bytes += len(data)
        while self._cached_bytes > CACHE_BYTES and len(self._cache) > 1:
            _, old = self._cache.popitem(last=False)
            self._cached_bytes -= len(old)
        return data

    def _decompress(self, number: int) -> bytes:
        ref = self.chunks[number]
        body = self._pread(ref.offset, ref.length)
        where = f"chunk {number} at byte {ref.offset}"
        if len(body) < _CHUNK.size:
            raise self._damaged(f"{where} is too short")
        _, _, size, crc, name_length = _CHUNK.unpack_from(body)
        at = _CHUNK.size + name_length
        name = body[_CHUNK.size : at].decode("ascii", "replace")
        if at + 8 > len(body) or size > MAX_CHUNK_BYTES:
            raise self._damaged(f"{where} says it has {size} bytes, at most {MAX_CHUNK_BYTES} are read")
        (length,) = struct.unpack_from("<Q", body, at)
        packed = memoryview(body)[at + 8 : at + 8 + length]
        try:
            data = self._unpack(name, packed, size)
        except (zstandard.ZstdError, RuntimeError, ValueError, EOFError) as error:
            raise self._damaged(f"{where} does not decompress: {error}") from error
        if len(data) != size or (crc and zlib.crc32(data) != crc):
            raise self._damaged(f"{where} has {len(data)} of {size} bytes and fails its checksum")
        return data

    def _unpack(self, compression: str, packed: memoryview, size: int) -> bytes:
        match compression:
            case "":
                return bytes(packed)
            case "zstd":
                return self._decompressor.decompress(packed, max_output_size=size) if size else b""
            case "lz4":
                decompressor = lz4.frame.LZ4FrameDecompressor()
                return bytes(decompressor.decompress(packed, max_length=size + 1)) if size else b""
        raise RecordingError(f"{self.path}: chunks are compressed with {compression!r}; known: zstd, lz4, none")

    def _unchunked(self, offset: int) -> memoryview:
        _, length = _RECORD.unpack(self._pread(offset, _RECORD.size))
        return memoryview(self._pread(offset, _RECORD.size + length))

    def _pread(self, offset: int, size: int, *, allow_short: bool = False) -> bytes:
        if self._fd < 0:
            raise RecordingError(f"the recording {self.path} is closed")
        if not allow_short and (size < 0 or offset + size > self._size):
            raise self._damaged(f"it points to {size} bytes at {offset}, but the file has {self._size}")
        data = os.pread(self._fd, size, offset)
        while len(data) < size and (more := os.pread(self._fd, size - len(data), offset + len(data))):
            data += more
        if len(data) < size and not allow_short:
            raise self._damaged(f"it ended at byte {offset + len(data)} while being read")
        return data

    def _parse(self, record: Any, body: bytes) -> Any:
        try:
            return record.read(ReadDataStream(io.BytesIO(body)))
        except (McapError, struct.error, UnicodeDecodeError, ValueError) as error:
            raise self._damaged(f"a {record.__name__} record cannot be read: {error!r}") from error

    def _damaged(self, what: str) -> RecordingError:
        return RecordingError(f"{self.path} is damaged: {what}; `mcap recover` may save what is left")


def _signed(log_time: int) -> int:
    return log_time if log_time < 2**63 else log_time - 2**64
