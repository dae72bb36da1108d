"""The chunks of an MCAP file, decompressed within bounds."""

from __future__ import annotations

import io
import struct
import zlib
from array import array
from collections.abc import MutableSequence
from dataclasses import dataclass

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import numpy.typing as npt
import zstandard

from dataflow.recording.errors import DamagedError
from dataflow.recording.limits import MAX_CHUNK_BYTES, MAX_RATIO, UNINDEXED_BYTES
from dataflow.recording.mcap.cache import ChunkCache
from dataflow.recording.mcap.rawfile import RECORD, RawFile

Column = npt.NDArray[np.int64]
Sizes = npt.NDArray[np.uint32]
LZ4_AT_ONCE = 2**26
"""Bytes that are asked of the LZ4 library at once: it takes twice as many."""

_CHUNK = struct.Struct("<QQQII")
CHUNK_HEAD = _CHUNK.size


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """One chunk: where its record's body begins in the file, and its entry in the index.

    `torn`: the file ends within it; `length` is what there is of it.
    """

    offset: int
    length: int
    uncompressed_size: int
    torn: bool = False


def size_in_head(head: bytes) -> int:
    """Returns the uncompressed size stated in the head of a chunk record's body."""
    return int(_CHUNK.unpack_from(head)[2])


class Chunks:
    """The chunks of one file by number."""

    def __init__(self, file: RawFile) -> None:
        self._starts: MutableSequence[int] | Column = array("q")
        self._lengths: MutableSequence[int] | Sizes = array("q")
        self._sizes: MutableSequence[int] | Sizes = array("q")
        self._torn = -1
        self._broken: dict[int, str] = {}
        """By number, why a chunk cannot be read: it is not tried again for each of its messages."""
        self._file = file
        self.cache = ChunkCache()
        self._packed_bytes = self._unpacked_bytes = 0
        self._decompressor = zstandard.ZstdDecompressor()

    def __len__(self) -> int:
        return len(self._starts)

    def add(self, ref: ChunkRef) -> int:
        """The number of a chunk."""
        assert isinstance(self._starts, array)
        assert isinstance(self._lengths, array)
        assert isinstance(self._sizes, array)
        number = len(self)
        self._starts.append(ref.offset - RECORD.size)
        self._lengths.append(ref.length + RECORD.size)
        self._sizes.append(min(ref.uncompressed_size, 2**63 - 1))
        if ref.torn:
            self._torn = number
        return number

    def adopt(self, starts: Column, lengths: Sizes, sizes: Sizes) -> None:
        """Takes all chunks as columns, which are not copied: where their records start, the bytes of these, and of what
        is in them."""
        self._starts, self._lengths, self._sizes = starts, lengths, sizes

    def ref(self, number: int) -> ChunkRef:
        """A chunk's place and sizes."""
        start, length = int(self._starts[number]) + RECORD.size, int(self._lengths[number]) - RECORD.size
        return ChunkRef(start, length, int(self._sizes[number]), number == self._torn)

    @property
    def lengths(self) -> Column:
        """Bytes in the file, by chunk."""
        return np.array(self._lengths, np.int64)

    @property
    def sizes(self) -> Column:
        """Uncompressed bytes, by chunk."""
        return np.array(self._sizes, np.int64)

    def data(self, number: int) -> bytes:
        """The records of a chunk, decompressed and checked."""
        key = (self, number)
        data = self.cache.get(key)
        if data is None:
            if (why := self._broken.get(number)) is not None:
                raise self._file.damaged(why)
            self.cache.make_room(key, self.ref(number).uncompressed_size)
            try:
                data = self._decompress(number)
            except DamagedError as error:
                self._broken[number] = error.what
                raise
            self.cache.add(key, data)
        return data

    def check_ratio(self, number: int) -> None:
        """Refuses a file whose chunks without a sound index, those asked about so far, expand beyond reason."""
        ref = self.ref(number)
        self._packed_bytes += ref.length
        self._unpacked_bytes += ref.uncompressed_size
        if self._unpacked_bytes > max(UNINDEXED_BYTES, MAX_RATIO * self._packed_bytes):
            raise self._file.damaged(
                f"its chunks up to byte {ref.offset + ref.length} expand from {self._packed_bytes} to "
                f"{self._unpacked_bytes} bytes and it has no index of them, so all would have to be expanded"
            )

    def where(self, number: int) -> str:
        return f"chunk {number} at byte {self.ref(number).offset}"

    def _decompress(self, number: int) -> bytes:
        ref = self.ref(number)
        where = self.where(number)
        body = self._file.read(ref.offset, ref.length)
        if len(body) < _CHUNK.size:
            raise self._file.damaged(f"{where} is too short")
        _, _, size, crc, name_length = _CHUNK.unpack_from(body)
        at = _CHUNK.size + name_length
        if at + 8 > len(body):
            raise self._file.damaged(f"{where} is too short")
        if size > MAX_CHUNK_BYTES:
            raise self._file.damaged(f"{where} states {size} bytes, at most {MAX_CHUNK_BYTES} are read")
        name = body[_CHUNK.size : at].decode("ascii", "replace")
        (length,) = struct.unpack_from("<Q", body, at)
        packed = memoryview(body)[at + 8 : at + 8 + length]
        try:
            data = self._unpack(name, packed, size, where, torn=ref.torn)
        except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
            raise self._file.damaged(f"{where} does not decompress: {error}") from error
        if ref.torn:
            return data[: _whole_records(data)]
        if len(data) != size:
            raise self._file.damaged(f"{where} does not hold the {size} bytes that it states")
        if crc and zlib.crc32(data) != crc:
            raise self._file.damaged(f"{where} fails its checksum")
        return data

    def _unpack(self, compression: str, packed: memoryview, size: int, where: str, *, torn: bool) -> bytes:
        """Returns at most `size` + 1 bytes, whatever the data states; of a torn chunk, those that can be unpacked."""
        match compression:
            case "":
                return bytes(packed[: size + 1])
            case "zstd":
                if not size:
                    return b""
                stated = -1 if torn else zstandard.frame_content_size(packed)
                if stated == size:
                    return self._decompressor.decompress(packed, max_output_size=size)
                if stated > size:  # one-shot decompression would believe it
                    raise self._file.damaged(f"{where} states {size} bytes, its zstd frame {stated}")
                with self._decompressor.stream_reader(packed, read_across_frames=True) as reader:
                    return reader.read(size + 1)
            case "lz4":
                return _unpack_lz4(packed, size + 1) if size else b""
        raise self._file.damaged(f"{where} is compressed with {compression!r}; known: zstd, lz4, none")


def _unpack_lz4(packed: memoryview, most: int) -> bytes:
    """The data of a frame, up to `most` bytes of it."""
    decompressor = lz4.frame.LZ4FrameDecompressor()
    unpacked = io.BytesIO()
    rest: memoryview | bytes = packed
    while not decompressor.eof and (left := most - unpacked.tell()):
        part = decompressor.decompress(rest, max_length=min(left, LZ4_AT_ONCE))
        if not part and decompressor.needs_input:
            break
        unpacked.write(part)
        rest = b""
    return unpacked.getvalue()


def _whole_records(data: bytes) -> int:
    """Returns how many bytes of records are whole at the beginning of `data`."""
    end = 0
    while end + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, end)
        if opcode == 0 or end + RECORD.size + length > len(data):
            break
        end += RECORD.size + length
    return end
