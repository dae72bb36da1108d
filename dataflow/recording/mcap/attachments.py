"""Attachments of an MCAP file, and the names under which those of several files, and their metadata, go into one.

Layout: https://mcap.dev/spec (attachment, op=0x09).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from itertools import count

import xxhash
from mcap.opcode import Opcode

from dataflow.recording.layout import DIGESTS, RECORDING
from dataflow.recording.limits import MAX_CHUNK_BYTES
from dataflow.recording.mcap.rawfile import RECORD, RawFile

_TIMES = struct.Struct("<QQ")
_LENGTH = struct.Struct("<I")
_SIZE = struct.Struct("<Q")
FACTS = frozenset({RECORDING, DIGESTS, "machine", "packages", "threads", "device"})


@dataclass(frozen=True, slots=True)
class Place:
    """The place of an attachment's record in a file: the byte of its opcode, and its bytes with opcode and length."""

    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside an MCAP file. `log_time`: when it was recorded, `created`: its own time or 0 (ns)."""

    name: str
    media_type: str
    log_time: int
    created: int
    data: bytes

    @property
    def key(self) -> Hashable:
        """Equal for attachments that are equal in all but their name."""
        return self.media_type, self.log_time, self.created, xxhash.xxh3_128_digest(self.data)


def read_attachment(file: RawFile, place: Place) -> Attachment:
    """Reads an attachment. Raises `DamagedError` where none is, where its checksum fails, and for one above 512 MiB."""
    where = f"the attachment at byte {place.offset}"
    if place.length > MAX_CHUNK_BYTES:
        raise file.damaged(f"{where} has {place.length} bytes, at most {MAX_CHUNK_BYTES} are read")
    record = file.read(place.offset, place.length)
    if len(record) < RECORD.size or RECORD.unpack_from(record) != (Opcode.ATTACHMENT, place.length - RECORD.size):
        raise file.damaged(f"{where} is none")
    try:
        log_time, created = _TIMES.unpack_from(record, RECORD.size)
        name, at = _text(record, RECORD.size + _TIMES.size)
        media_type, at = _text(record, at)
        (size,) = _SIZE.unpack_from(record, at)
        start, end = at + _SIZE.size, at + _SIZE.size + size
        (crc,) = _LENGTH.unpack_from(record, end)
    except (struct.error, UnicodeDecodeError) as error:
        raise file.damaged(f"{where} cannot be read: {error}") from error
    if crc and zlib.crc32(memoryview(record)[RECORD.size : end]) != crc:
        raise file.damaged(f"attachment {name!r} at byte {place.offset} fails its checksum")
    return Attachment(name, media_type, log_time, created, record[start:end])


def _text(record: bytes, at: int) -> tuple[str, int]:
    (length,) = _LENGTH.unpack_from(record, at)
    start, end = at + _LENGTH.size, at + _LENGTH.size + length
    if end > len(record):
        raise struct.error("a text is longer than the record")
    return record[start:end].decode(), end


def tells_of_run(name: str) -> bool:
    """Returns whether metadata of this name describe a run of a graph, or a recording of ours."""
    return name in FACTS or name.startswith("dataflow:")


def names_once(files: Sequence[tuple[str, Sequence[tuple[str, Hashable]]]]) -> list[list[str | None]]:
    """The names under which what several files hold goes into one; None for what an earlier file holds equally.

    `files`: by file its label, and what it holds as (name, content). The first file's names stay. Content of a name
    that an earlier file has for something else is called `LABEL/NAME`, and `LABEL/NAME 2` where that is taken. Pure.
    """
    all_names = {name for _, items in files for name, _ in items}
    held: dict[str, set[Hashable]] = {}
    used: set[str] = set()
    found: list[list[str | None]] = []
    for label, items in files:
        names: list[str | None] = []
        for name, content in items:
            if content in held.get(name, ()):
                names.append(None)
            elif name in held:
                names.append(_free(f"{label}/{name}", used | all_names))
            else:
                names.append(name)
        for name, content in items:
            held.setdefault(name, set()).add(content)
        used |= {name for name in names if name is not None}
        found.append(names)
    return found


def _free(name: str, taken: Collection[str]) -> str:
    return next(tried for k in count(1) if (tried := name if k == 1 else f"{name} {k}") not in taken)
