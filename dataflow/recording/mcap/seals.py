"""Checksums of the records outside chunks: one more field at a record's end, which other readers skip.

MCAP gives checksums to chunks and to the summary, not to headers, schemas, channels, metadata and message indexes; but
it lets any record be extended by fields at its end (https://mcap.dev/spec). Ours is a tag and a CRC-32 over the whole
record before it, opcode and extended length included.
"""

from __future__ import annotations

import struct
import zlib
from enum import Enum

TAG = b"crc="
_RECORD = struct.Struct("<BQ")
_SEAL = struct.Struct("<4sI")


class Seal(Enum):
    """Verdict of a record's checksum."""

    SOUND = "sound"
    BROKEN = "broken"
    ABSENT = "absent"


def sealed(record: bytes) -> bytes:
    """`record`, extended by its checksum."""
    opcode, length = _RECORD.unpack_from(record)
    body = _RECORD.pack(opcode, length + _SEAL.size) + record[_RECORD.size :] + TAG
    return body + struct.pack("<I", zlib.crc32(body))


def seal_of(record: bytes) -> Seal:
    """Returns whether a whole record, opcode and length included, is as it was sealed."""
    if len(record) < _RECORD.size + _SEAL.size:
        return Seal.ABSENT
    tag, crc = _SEAL.unpack_from(record, len(record) - _SEAL.size)
    if tag != TAG:
        return Seal.ABSENT
    return Seal.SOUND if zlib.crc32(memoryview(record)[:-4]) == crc else Seal.BROKEN
