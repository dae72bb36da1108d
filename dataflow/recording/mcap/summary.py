"""Reads the summary at the end of an MCAP file."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, MetadataIndex, Statistics

from dataflow.recording.errors import DamagedError
from dataflow.recording.mcap.attachments import Place
from dataflow.recording.mcap.chunk_indexes import ChunkIndexes, ChunkIndexReader
from dataflow.recording.mcap.chunks import Column
from dataflow.recording.mcap.contents import Contents
from dataflow.recording.mcap.ending import MAGIC
from dataflow.recording.mcap.message_index import LoadedIndex, LongIndex, MessageIndex, steps, take_messages
from dataflow.recording.mcap.rawfile import RECORD, RawFile
from dataflow.recording.mcap.seals import Seal, seal_of

_FOOTER = struct.Struct("<BQQQI")
TAIL_BYTES = _FOOTER.size + len(MAGIC)
BLOCK_BYTES = 2**24
"""Of the summary, in memory at a time."""
LONG = 2**14
"""Chunks of a file beyond which its message indexes are read as they are needed: all would take seconds."""
LONG_BYTES = 2**24
"""Bytes of its message indexes, 16 a message, beyond which they are so too: in memory all would take half as much
again."""


class MiscountedError(DamagedError):
    """A file whose statistics count other messages than its index: `counts`, by channel."""

    counts: Mapping[int, int] = {}


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


@dataclass(frozen=True, slots=True)
class Summary:
    """Contents of a file according to its summary; `index`: of its messages."""

    contents: Contents
    index: MessageIndex


def read_summary(file: RawFile, footer: Footer, *, sealed: bool) -> Summary | None:
    """Returns the summary; None where it does not suffice to find every message.

    Raises `DamagedError` where it fails its checksum or contradicts itself or the file. Chunks, message indexes and
    metadata must not overlap, so that what is read is bounded by the size of the file. The message indexes of a long
    file (`LONG`, `LONG_BYTES`) are read and checked as they are needed, those of others at once.
    """
    if not footer.summary_start:
        if footer.crc and zlib.crc32(footer.head) != footer.crc:
            raise file.damaged(f"its footer at byte {file.size - TAIL_BYTES} fails its checksum")
        return None
    contents = Contents(file)
    chunks = ChunkIndexReader(file, max(0, file.size - footer.summary_start))
    metadata: list[MetadataIndex] = []
    statistics: Statistics | None = None
    for block, at, records, others in _blocks(file, footer):
        chunks.add(block, records, at)
        for opcode, place, length in others:
            start, offset = place + RECORD.size, at + place
            body = block[start : start + length]
            match opcode:
                case Opcode.SCHEMA | Opcode.CHANNEL:
                    contents.declare(opcode, body, offset)
                case Opcode.METADATA_INDEX:
                    contents.count_parsed(offset)
                    metadata.append(file.parse(MetadataIndex, body, offset))
                case Opcode.ATTACHMENT_INDEX:
                    index = file.parse(AttachmentIndex, body, offset)
                    contents.add_attachment(Place(index.offset, index.length))
                case Opcode.STATISTICS:
                    statistics = file.parse(Statistics, body, offset)
    indexes = chunks.done()
    _read_metadata(contents, metadata, sealed)
    if not np.diff(indexes.rows).all() or not (
        len(indexes) or (statistics is not None and statistics.message_count == 0)
    ):
        return None
    contents.chunks.adopt(indexes.starts, indexes.lengths, indexes.sizes)
    long = len(indexes) > LONG or int(indexes.index_lengths.sum(dtype=np.int64)) > LONG_BYTES
    found = _long(contents, indexes, statistics, sealed) if long else _loaded(contents, indexes, sealed)
    if found is None or contents.undeclared():
        return None
    _compare(contents, statistics, found)
    return Summary(contents, found)


def _blocks(file: RawFile, footer: Footer) -> Iterator[tuple[bytes, int, Column, list[tuple[int, int, int]]]]:
    """The records of the summary, some at a time: their bytes, where these lie, the places of chunk indexes among them,
    and (opcode, place, length) of others. Raises `DamagedError` at the end where they fail their checksum."""
    at, end = footer.summary_start, file.size - TAIL_BYTES
    if not len(MAGIC) <= at <= end:
        raise file.damaged(f"its footer puts the summary at byte {at} of {file.size}")
    crc, unpack, head, wanted = 0, RECORD.unpack_from, RECORD.size, int(Opcode.CHUNK_INDEX)
    while at + head <= end:
        block = file.read(at, min(BLOCK_BYTES, end - at))
        chunks, others = array("q"), list[tuple[int, int, int]]()
        place, size = 0, len(block)
        while place + head <= size:
            opcode, length = unpack(block, place)
            following = place + head + length
            if following > size:
                break
            if opcode == wanted:
                chunks.append(place)
            else:
                others.append((opcode, place, length))
            place = following
        if not place:
            opcode, length = unpack(block)
            if at + head + length > end or opcode == wanted:
                raise file.damaged(f"its summary ends within the record at byte {at}")
            block, place = file.record(at, length), head + length
            others.append((opcode, 0, length))
        block = block[:place]
        crc = zlib.crc32(block, crc)
        yield block, at, np.frombuffer(chunks, np.int64) if len(chunks) else np.empty(0, np.int64), others
        at += place
    crc = zlib.crc32(file.read(at, end - at), crc)
    if footer.crc and zlib.crc32(footer.head, crc) != footer.crc:
        raise file.damaged(f"its summary at byte {footer.summary_start} fails its checksum")


def _loaded(contents: Contents, indexes: ChunkIndexes, sealed: bool) -> LoadedIndex:
    for numbers in steps(indexes, np.arange(len(indexes))):
        take_messages(contents, indexes, numbers, sealed=sealed)
    return LoadedIndex(contents.entries())


def _long(contents: Contents, indexes: ChunkIndexes, statistics: Statistics | None, sealed: bool) -> LongIndex | None:
    if not contents.channels.keys() >= set(np.unique(indexes.channels).tolist()):
        return None
    counts = None if statistics is None else statistics.channel_message_counts
    return LongIndex(contents.file, contents.chunks, indexes, sealed=sealed, counts=counts, damage=contents.damage)


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
        contents.take_metadata(body, index.offset)


def _names(metadata: bytes, name: str) -> bool:
    encoded = name.encode()
    return metadata.startswith(struct.pack("<I", len(encoded)) + encoded)


def _compare(contents: Contents, statistics: Statistics | None, index: MessageIndex) -> None:
    """Raises `DamagedError` where the statistics count other messages than the index."""
    if statistics is None:
        return
    if statistics.attachment_count > len(contents.attachments):
        contents.damage.append(
            f"its statistics count {statistics.attachment_count} attachments, its index {len(contents.attachments)}"
        )
    for channel, count in statistics.channel_message_counts.items():
        if index.count(channel) != count:
            error = MiscountedError.of(
                contents.file.path,
                f"its statistics count {count} messages of channel {channel}, its index {index.count(channel)}",
            )
            error.counts = statistics.channel_message_counts
            raise error
