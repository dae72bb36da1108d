"""The end of an MCAP file: what its summary is made of, and how that follows on the messages.

Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd, Footer, McapRecord, SummaryOffset

MAGIC = b"\x89MCAP0\r\n"
KEPT_BYTES = 2**20
"""Of chunk index records, in memory uncompressed."""


def record_bytes(record: McapRecord) -> bytes:
    """`record` as it lies in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


class KeptIndexes:
    """Keeps the chunks' index records as they will lie in the file, compressed: a run of days has millions."""

    def __init__(self) -> None:
        """`content_bytes`: of what is in the chunks, uncompressed."""
        self._packed: list[bytes] = []
        self._newest = bytearray()
        self.count = 0
        self.content_bytes = 0

    def add(self, indexes: Iterable[ChunkIndex]) -> None:
        """Takes the indexes of the next chunks."""
        for index in indexes:
            self._newest += record_bytes(index)
            self.count += 1
            self.content_bytes += index.uncompressed_size
        if len(self._newest) >= KEPT_BYTES:
            self._packed.append(zlib.compress(self._newest, 1))
            self._newest.clear()

    def records(self) -> Iterator[bytes]:
        """The records, some at a time."""
        yield from map(zlib.decompress, self._packed)
        yield bytes(self._newest)


def ending(position: int, groups: Mapping[int, Iterable[bytes]]) -> Iterator[bytes]:
    """Data end, summary, footer and magic, as they follow at `position`. `groups`: by opcode the summary's records."""
    data_end = record_bytes(DataEnd(data_section_crc=0))
    yield data_end
    start = end = position + len(data_end)
    crc = 0
    offsets = b""
    for opcode, parts in groups.items():
        begin = end
        for part in parts:
            crc, end = zlib.crc32(part, crc), end + len(part)
            yield part
        if end > begin:
            offsets += record_bytes(SummaryOffset(opcode, group_start=begin, group_length=end - begin))
    yield offsets
    crc = zlib.crc32(offsets, crc)
    crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, end), crc)
    yield record_bytes(Footer(summary_start=start, summary_offset_start=end, summary_crc=crc)) + MAGIC
