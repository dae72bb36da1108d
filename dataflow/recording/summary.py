"""Reads the summary at the end of an MCAP file."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex, Statistics

from dataflow.recording.attachments import Place
from dataflow.recording.chunks import ChunkRef
from dataflow.recording.container import MAGIC
from dataflow.recording.contents import Contents
from dataflow.recording.rawfile import RECORD, RawFile
from dataflow.recording.seals import Seal, seal_of

_FOOTER = struct.Struct("<BQQQI")
TAIL_BYTES = _FOOTER.size + len(MAGIC)
MAX_SUMMARY_BYTES = 2**28


@dataclass(frozen=True, slots=True)
class Footer:
    """The last record: where the summary begins (0: there is none), and its checksum (0: not known)."""

    summary_start: int
    head: bytes
    crc: int


def read_footer(file: RawFile) -> Footer | None:
    """The footer; None for a file that does not end with one."""
    if file.size < len(MAGIC) + TAIL_BYTES:
        return None
    data = file.read(file.size - TAIL_BYTES, TAIL_BYTES)
    opcode, _, start, _, crc = _FOOTER.unpack_from(data)
    if data[_FOOTER.size :] != MAGIC or opcode != Opcode.FOOTER:
        return None
    return Footer(start, data[: _FOOTER.size - 4], crc)


def read_summary(file: RawFile, footer: Footer, *, sealed: bool) -> Contents | None:
    """Returns what the summary tells; None where it does not suffice to find every message.

    Raises `DamagedError` where it fails its checksum or contradicts itself or the file. Chunks, message indexes and
    metadata must not overlap, so that what is read is bounded by the size of the file.
    """
    if not footer.summary_start:
        if footer.crc and zlib.crc32(footer.head) != footer.crc:
            raise file.damaged(f"its footer at byte {file.size - TAIL_BYTES} fails its checksum")
        return None
    data = _summary_bytes(file, footer)
    contents = Contents(file)
    chunks: list[ChunkIndex] = []
    metadata: list[MetadataIndex] = []
    statistics: Statistics | None = None
    position = 0
    while position + RECORD.size <= len(data):
        at = footer.summary_start + position
        opcode, length = RECORD.unpack_from(data, position)
        body = data[position + RECORD.size : position + RECORD.size + length]
        if len(body) != length:
            raise file.damaged(f"its summary ends within the record at byte {at}")
        match opcode:
            case Opcode.SCHEMA | Opcode.CHANNEL:
                contents.declare(opcode, body, at)
            case Opcode.CHUNK_INDEX:
                contents.count_parsed(at)
                chunks.append(file.parse(ChunkIndex, body, at))
            case Opcode.METADATA_INDEX:
                contents.count_parsed(at)
                metadata.append(file.parse(MetadataIndex, body, at))
            case Opcode.ATTACHMENT_INDEX:
                index = file.parse(AttachmentIndex, body, at)
                contents.add_attachment(Place(index.offset, index.length))
            case Opcode.STATISTICS:
                statistics = file.parse(Statistics, body, at)
        position += RECORD.size + length
    _read_metadata(contents, metadata, sealed)
    if not all(index.message_index_offsets for index in chunks) or not (
        chunks or (statistics is not None and statistics.message_count == 0)
    ):
        return None
    _read_chunks(contents, chunks, sealed)
    if contents.undeclared():
        return None
    _compare(contents, statistics)
    return contents


def _summary_bytes(file: RawFile, footer: Footer) -> bytes:
    size = file.size - TAIL_BYTES - footer.summary_start
    if footer.summary_start < len(MAGIC) or not 0 <= size <= MAX_SUMMARY_BYTES:
        raise file.damaged(f"its footer puts the summary at byte {footer.summary_start} of {file.size}")
    data = file.read(footer.summary_start, size)
    if footer.crc and zlib.crc32(footer.head, zlib.crc32(data)) != footer.crc:
        raise file.damaged(f"its summary at byte {footer.summary_start} fails its checksum")
    return data


def _read_metadata(contents: Contents, indexes: list[MetadataIndex], sealed: bool) -> None:
    """Takes the metadata records; one that is damaged is left out and noted."""
    file = contents.file
    free = len(MAGIC)
    for index in sorted(indexes, key=lambda i: i.offset):
        if index.offset < free or index.length < RECORD.size:
            raise file.damaged(f"its index puts metadata {index.name!r} at byte {index.offset}, among other records")
        free = index.offset + index.length
        record = file.record(index.offset, index.length - RECORD.size)
        intact = RECORD.unpack_from(record) == (Opcode.METADATA, len(record) - RECORD.size)
        intact = intact and (seal_of(record) is Seal.SOUND or not sealed)
        body = record[RECORD.size :]
        if not intact or not _names(body, index.name):
            contents.damage.append(f"metadata {index.name!r} at byte {index.offset} is damaged and left out")
            continue
        contents.add_metadata(body, index.offset)


def _names(metadata: bytes, name: str) -> bool:
    encoded = name.encode()
    return metadata.startswith(struct.pack("<I", len(encoded)) + encoded)


def _read_chunks(contents: Contents, indexes: list[ChunkIndex], sealed: bool) -> None:
    """Takes the messages of every chunk: by its message indexes, or where they are damaged by its content."""
    file = contents.file
    free = len(MAGIC)
    for index in sorted(indexes, key=lambda i: i.chunk_start_offset):
        start, end = index.chunk_start_offset, index.chunk_start_offset + index.chunk_length
        if start < free or index.chunk_length < RECORD.size:
            raise file.damaged(f"its index puts a chunk at byte {start}, among other records")
        free = end + index.message_index_length
        ref = ChunkRef(start + RECORD.size, index.chunk_length - RECORD.size, index.uncompressed_size)
        number = contents.chunks.add(ref)
        bodies = _message_indexes(file, end, index, sealed)
        if bodies is None or not contents.add_indexes(number, bodies):
            contents.take_chunk(number)
            contents.damage.append(
                f"the message index at byte {end} is damaged; {contents.chunks.where(number)} was read instead"
            )


def _message_indexes(file: RawFile, start: int, index: ChunkIndex, sealed: bool) -> list[bytes] | None:
    """The bodies of the message indexes behind a chunk; None where they are not what the chunk index says."""
    data = file.read(start, index.message_index_length)
    bodies: list[bytes] = []
    found: dict[int, int] = {}
    position = 0
    while position + RECORD.size + 2 <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        end = position + RECORD.size + length
        if opcode != Opcode.MESSAGE_INDEX or end > len(data):
            return None
        if sealed and seal_of(data[position:end]) is not Seal.SOUND:
            return None
        bodies.append(data[position + RECORD.size : end])
        found[int.from_bytes(bodies[-1][:2], "little")] = start + position
        position = end
    return bodies if position == len(data) and found == index.message_index_offsets else None


def _compare(contents: Contents, statistics: Statistics | None) -> None:
    """Raises `DamagedError` where the statistics count other messages than the index."""
    if statistics is None:
        return
    if statistics.attachment_count > len(contents.attachments):
        contents.damage.append(
            f"its statistics count {statistics.attachment_count} attachments, its index {len(contents.attachments)}"
        )
    found = contents.counts()
    for channel, count in statistics.channel_message_counts.items():
        if found.get(channel, 0) != count:
            raise contents.file.damaged(
                f"its statistics count {count} messages of channel {channel}, its index {found.get(channel, 0)}"
            )
