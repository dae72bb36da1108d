"""Saves the messages of broken ROS bags, by reading records wherever they lie and believing no index.

SQLite: leaf pages of tables hold rows (SQLite file format 1.6), whose large values go on in overflow pages. ROS 1:
records follow each other, in chunks or not (ROS bag format 2.0).
"""

from __future__ import annotations

import bz2
import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from dataflow.recording.codecs import SchemaText
from dataflow.recording.errors import RecordingError

LEAF = 0x0D
"""First byte of a page that holds rows of a table."""
SQLITE_HEADER = 100
ROS1_START = b"#ROSBAG V2.0\n"
MAX_PAYLOAD = 1 << 30


class Saved(NamedTuple):
    """One message that was found whole."""

    topic: str
    log_time: int
    data: bytes


@dataclass(slots=True)
class Salvage:
    """The content that is left of a broken bag. `lost`: messages of which a part is missing; `notes`: for people."""

    encoding: str
    schemas: dict[str, SchemaText] = field(default_factory=dict)
    messages: list[Saved] = field(default_factory=list)
    lost: int = 0
    notes: list[str] = field(default_factory=list)


def salvage(path: Path) -> Salvage:
    """Reads a broken SQLite bag or ROS 1 bag. Raises `RecordingError` for any other file."""
    with path.open("rb") as file:
        head = file.read(SQLITE_HEADER)
    if head.startswith(b"SQLite format 3\x00"):
        return _Database(path, head).salvage()
    if head.startswith(ROS1_START):
        return _ros1(path)
    raise RecordingError(f"{path} is neither a SQLite database nor a ROS 1 bag of version 2.0")


class _Database:
    """Pages of a database, the last ones missing or damaged."""

    def __init__(self, path: Path, head: bytes) -> None:
        self._path = path
        size = int.from_bytes(head[16:18], "big")
        self._size = 65536 if size == 1 else size
        self._usable = self._size - (head[20] if len(head) > 20 else 0)
        if self._size < 512 or self._size & (self._size - 1):
            raise RecordingError(f"{path}: the size of its pages is {self._size}: its header is damaged")

    def salvage(self) -> Salvage:
        found = Salvage("cdr")
        names: dict[int, tuple[str, str]] = {}
        texts: dict[str, SchemaText] = {}
        rows: dict[int, tuple[int, int, bytes]] = {}
        with self._path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for identity, values in self._rows(data, found):
                match values:
                    case [None, int(topic), int(time), bytes(content)]:
                        rows.setdefault(identity, (topic, time, content))
                    case [None, str(name), str(kind), "cdr", *_]:
                        names.setdefault(identity, (name, kind))
                    case [None, str(kind), "ros2msg" | "ros2idl" as encoding, str(text), *_]:
                        texts.setdefault(kind, SchemaText(kind, encoding, text.encode()))
        for topic, time, content in sorted(rows.values(), key=lambda row: row[1]):
            name, kind = names.get(topic, (f"/topic_{topic}", ""))
            found.schemas.setdefault(name, texts.get(kind, SchemaText(kind, "", b"")))
            found.messages.append(Saved(name, time, content))
        unnamed = {topic for topic, _, _ in rows.values()} - names.keys()
        if unnamed:
            found.notes.append(f"the names of {len(unnamed)} topics are lost: they are called by their numbers")
        return found

    def _rows(self, data: mmap.mmap, found: Salvage) -> Iterator[tuple[int, list[Any]]]:
        """(rowid, values) of every row that is whole."""
        for start in range(0, len(data) - self._size + 1, self._size):
            head = start + (SQLITE_HEADER if start == 0 else 0)
            if data[head] != LEAF:
                continue
            cells = int.from_bytes(data[head + 3 : head + 5], "big")
            if head + 8 + 2 * cells > start + self._size:
                continue
            for place in struct.unpack_from(f">{cells}H", data, head + 8):
                try:
                    yield self._row(data, start, place)
                except _Missing:
                    found.lost += 1
                except (ValueError, IndexError, struct.error):
                    continue  # overflow pages and free pages may begin like one of rows

    def _row(self, data: mmap.mmap, start: int, place: int) -> tuple[int, list[Any]]:
        length, at = _varint(data, start + place)
        identity, at = _varint(data, at)
        if not 0 < length <= MAX_PAYLOAD:
            raise ValueError(length)
        within = self._usable - 35
        if length <= within:
            local = length
        else:
            least = (self._usable - 12) * 32 // 255 - 23
            local = least + (length - least) % (self._usable - 4)
            local = local if local <= within else least
        if at + local > start + self._size:
            raise ValueError(place)
        parts = [data[at : at + local]]
        if local < length:
            self._follow(data, int.from_bytes(data[at + local : at + local + 4], "big"), length - local, parts)
        return identity, _values(b"".join(parts))

    def _follow(self, data: mmap.mmap, page: int, left: int, parts: list[bytes]) -> None:
        """Adds the rest of a row, which is in overflow pages."""
        if not 0 < page < 1 << 31:
            raise ValueError(page)
        while left > 0:
            start = (page - 1) * self._size
            if page == 0 or start + self._size > len(data):
                raise _Missing
            taken = min(left, self._usable - 4)
            parts.append(data[start + 4 : start + 4 + taken])
            left -= taken
            page = int.from_bytes(data[start : start + 4], "big")


class _Missing(Exception):
    """A part of a row lies beyond the end of the file."""


def _varint(data: Any, at: int) -> tuple[int, int]:
    """(value, place after it) of SQLite's integers of 1 to 9 bytes."""
    value = 0
    for k in range(9):
        byte = data[at + k]
        if k == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + k + 1
    raise AssertionError("a ninth byte ends it")


_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}


def _values(record: bytes) -> list[Any]:
    """The values of a record. Raises ValueError for what is none."""
    size, at = _varint(record, 0)
    if not 0 < size <= len(record) or size > 1000:
        raise ValueError(size)
    kinds = []
    while at < size:
        kind, at = _varint(record, at)
        kinds.append(kind)
    values: list[Any] = []
    for kind in kinds:
        length = 0
        if kind == 0:
            values.append(None)
        elif kind in (8, 9):
            values.append(kind - 8)
        elif kind in _INTEGERS:
            length = _INTEGERS[kind]
            values.append(int.from_bytes(record[at : at + length], "big", signed=True))
        elif kind == 7:
            length = 8
            values.append(struct.unpack(">d", record[at : at + 8])[0])
        elif kind >= 12:
            length = (kind - 12) // 2
            content = record[at : at + length]
            values.append(content if kind % 2 == 0 else content.decode())
        else:
            raise ValueError(kind)
        at += length
    if at != len(record):
        raise ValueError(at)
    return values


# -------------------------------------------------------------------------------------------------------- ROS 1

_BAG_HEADER, _CHUNK, _CONNECTION, _MESSAGE = 0x03, 0x05, 0x07, 0x02


def _ros1(path: Path) -> Salvage:
    found = Salvage("ros1")
    topics: dict[int, str] = {}
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for fields, content, whole in _records(data, len(ROS1_START)):
            if fields.get("op") == bytes([_CHUNK]):
                inner = _unpacked(fields.get("compression", b"none"), content, found)
                for one, body, complete in _records(inner, 0):
                    _take(one, body, complete, topics, found)
            else:
                _take(fields, content, whole, topics, found)
    found.messages.sort(key=lambda message: message.log_time)
    return found


def _take(fields: dict[str, bytes], content: bytes, whole: bool, topics: dict[int, str], found: Salvage) -> None:
    op = fields.get("op")
    if op == bytes([_CONNECTION]) and whole:
        number, topic = int.from_bytes(fields["conn"], "little"), fields["topic"].decode()
        about = dict(_fields(content))
        topics[number] = topic
        kind = about.get("type", b"").decode()
        found.schemas.setdefault(topic, SchemaText(kind, "ros1msg", about.get("message_definition", b"")))
    elif op == bytes([_MESSAGE]):
        topic = topics.get(int.from_bytes(fields["conn"], "little"), "")
        if not (whole and topic):
            found.lost += 1
            return
        seconds, nanoseconds = struct.unpack("<II", fields["time"])
        found.messages.append(Saved(topic, seconds * 10**9 + nanoseconds, content))


def _records(data: Any, at: int) -> Iterator[tuple[dict[str, bytes], bytes, bool]]:
    """(header fields, data, whether it is whole) of the records that follow each other."""
    end = len(data)
    while at + 4 <= end:
        length = int.from_bytes(data[at : at + 4], "little")
        begin = at + 4 + length
        if begin + 4 > end:
            return
        fields = dict(_fields(data[at + 4 : begin]))
        size = int.from_bytes(data[begin : begin + 4], "little")
        if "op" not in fields or size > MAX_PAYLOAD:
            return
        yield fields, bytes(data[begin + 4 : begin + 4 + size]), begin + 4 + size <= end
        at = begin + 4 + size


def _fields(header: bytes) -> Iterator[tuple[str, bytes]]:
    at = 0
    while at + 4 <= len(header):
        length = int.from_bytes(header[at : at + 4], "little")
        name, separator, value = header[at + 4 : at + 4 + length].partition(b"=")
        if separator:
            yield name.decode("latin-1"), value
        at += 4 + length


def _unpacked(compression: bytes, content: bytes, found: Salvage) -> bytes:
    """The records of a chunk, as far as it goes."""
    try:
        if compression == b"bz2":
            return bz2.BZ2Decompressor().decompress(content)
        if compression == b"lz4":
            from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

            return bytes(LZ4FrameDecompressor().decompress(content))
    except (OSError, RuntimeError, EOFError) as error:
        found.notes.append(f"a {compression.decode()} chunk cannot be unpacked: {error}")
        return b""
    return content
