"""Broken bags, read record by record wherever they lie, believing no index.

SQLite: leaf pages of tables hold rows (SQLite file format 1.6), whose large values go on in overflow pages. ROS 1:
records follow each other, in chunks or not (ROS bag format 2.0).
"""

from __future__ import annotations

import bz2
import mmap
import re
import struct
from array import array
from collections import OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.interop.bag import Topic, is_latched
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.codecs import SchemaText

LEAF = 0x0D
"""First byte of a page that holds rows of a table."""
SQLITE_HEADER = 100
SQLITE_START = b"SQLite format 3\x00"
ROS1_START = b"#ROSBAG V2.0\n"
MAX_PAYLOAD = 1 << 30
KEPT_CHUNKS = 8
NO_SCHEMA = SchemaText("", "", b"")

Row = tuple[int, int, bytes]
"""(log time, number of the topic, message)"""


class DamagedFile:
    """The messages that are left of a broken file: their places, and what one holds when it is asked for.

    `encoding`: of messages; `lost`: how many lack a part, as far as that shows; `notes`: for people; `parts`: what it
    is read by.
    """

    encoding, parts = "", "records"

    def __init__(self, path: Path) -> None:
        self.path, self.lost = path, 0
        self.notes: list[str] = []
        self._about: dict[int, tuple[str, SchemaText, str, bool]] = {}
        """By number of a topic: name, schema, QoS profiles, whether it is latched."""
        self._columns = [array("q") for _ in range(5)]
        with path.open("rb") as file:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def _add(self, time: int, topic: int, *place: int) -> None:
        """Takes a message of the log."""
        for column, value in zip(self._columns, (time, topic, *place), strict=True):
            column.append(value)

    def _settle(self, *, by_number: bool = False) -> None:
        """Puts the messages in the order of their times; equal ones in that of the file, or of their last number."""
        columns = np.array(self._columns, np.int64).reshape(5, -1)
        ties = columns[4] if by_number else np.arange(columns.shape[1])
        self._rows = columns[:, np.lexsort((ties, columns[0]))]

    def topics(self) -> Iterator[tuple[int, Topic]]:
        """The topics by number: those that are declared, and those that hold a message."""
        times, owners = self._rows[0], self._rows[1]
        for number in sorted({*self._about, *np.unique(owners).tolist()}):
            found = times[owners == number]
            unnamed = (f"/topic_{number}", NO_SCHEMA, "", False)
            name, schema, profiles, latched = self._about.get(number, unnamed)
            first, last = (int(found[0]), int(found[-1])) if len(found) else (None, None)
            latched = latched or is_latched(name, profiles)
            channel = {"offered_qos_profiles": profiles} if profiles else {}
            yield number, Topic(name, self.encoding, schema, len(found), first, last, None, latched, channel)

    def losses(self) -> list[str]:
        """Notes, and how many messages are known to be missing, for people."""
        return [*self.notes, *([f"messages that are missing: {self.lost:,}"] if self.lost else [])]

    def counts(self) -> dict[int, int]:
        """Messages by number of their topic."""
        numbers, held = np.unique(self._rows[1], return_counts=True)
        return dict(zip(numbers.tolist(), held.tolist(), strict=True))

    def rows(self, topics: Collection[int], time: int | None = None, skip: int = 0) -> Iterator[Row]:
        """The messages of some topics by log time: those from `time` on, without the first `skip` of that time."""
        chosen = np.flatnonzero(np.isin(self._rows[1], list(topics)))
        if time is not None:
            chosen = chosen[int(np.searchsorted(self._rows[0][chosen], time)) + skip :]
        for at in chosen.tolist():
            stamp, topic, *place = self._rows[:, at].tolist()
            yield stamp, topic, self._read(*place)

    def _read(self, *place: int) -> bytes:
        raise NotImplementedError

    def close(self) -> None:
        """Closes the file. Idempotent."""
        self._data.close()


def salvage(path: Path) -> DamagedFile:
    """Opens a broken SQLite bag or ROS 1 bag. Raises `RecordingError` for any other file."""
    with path.open("rb") as file:
        head = file.read(SQLITE_HEADER)
    if head.startswith(SQLITE_START):
        return DamagedDatabase(path)
    if head.startswith(ROS1_START):
        return DamagedRos1Bag(path)
    raise RecordingError(f"{path} is neither a SQLite database nor a ROS 1 bag of version 2.0")


class DamagedDatabase(DamagedFile):
    """Pages of a database, the last ones missing or some damaged. Raises `RecordingError` without a sound header."""

    encoding, parts = "cdr", "pages"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        head = self._data[:SQLITE_HEADER]
        size = int.from_bytes(head[16:18], "big")
        self._size = 65536 if size == 1 else size
        self._usable = self._size - (head[20] if len(head) > 20 else 0)
        if self._size < 512 or self._size & (self._size - 1):
            self.close()
            raise RecordingError(f"{path}: the size of its pages is {self._size}: its header is damaged")
        stated = int.from_bytes(head[28:32], "big")
        if stated * self._size > len(self._data):
            self.notes.append(f"it has {len(self._data) // self._size:,} of its {stated:,} pages")
        self._find()
        self._settle(by_number=True)

    def _find(self) -> None:
        texts: dict[str, SchemaText] = {}
        numbers: set[int] = set()
        for identity, values, start, place in self._found():
            match values:
                case [None, int(topic), int(time), bytes()] if identity not in numbers:
                    numbers.add(identity)
                    self._add(time, topic, start, place, identity)
                case [None, str(name), str(kind), "cdr", *rest]:
                    profiles = next((text for text in rest if isinstance(text, str)), "")
                    self._about.setdefault(identity, (name, SchemaText(kind, "", b""), profiles, False))
                case [None, str(kind), "ros2msg" | "ros2idl" as encoding, str(text), *_]:
                    texts.setdefault(kind, SchemaText(kind, encoding, text.encode()))
        for number, (name, schema, profiles, latched) in self._about.items():
            self._about[number] = (name, texts.get(schema.name, schema), profiles, latched)
        if numbers:  # rosbag2 numbers its messages one by one and deletes none
            self.lost = max(self.lost, max(numbers) - min(numbers) + 1 - len(numbers))
        unnamed = set(self._columns[1]) - self._about.keys()
        if unnamed:
            self.notes.append(f"the names of {len(unnamed)} topics are lost: they are called by their numbers")

    def _read(self, *place: int) -> bytes:
        content = self._row(place[0], place[1])[1][3]
        assert isinstance(content, bytes)
        return content

    def _found(self) -> Iterator[tuple[int, list[Any], int, int]]:
        """(rowid, values, start of the page, place in it) of every row that is whole."""
        data = self._data
        for start in range(0, len(data) - self._size + 1, self._size):
            head = start + (SQLITE_HEADER if start == 0 else 0)
            if data[head] != LEAF:
                continue
            cells = int.from_bytes(data[head + 3 : head + 5], "big")
            if head + 8 + 2 * cells > start + self._size:
                continue
            for place in struct.unpack_from(f">{cells}H", data, head + 8):
                try:
                    yield (*self._row(start, place), start, place)
                except _Missing:
                    self.lost += 1
                except (ValueError, IndexError, struct.error):
                    continue  # overflow pages and free pages may begin like one of rows

    def _row(self, start: int, place: int) -> tuple[int, list[Any]]:
        """(rowid, values) of the row that begins at `place` of the page at `start`."""
        data = self._data
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
            self._follow(int.from_bytes(data[at + local : at + local + 4], "big"), length - local, parts)
        return identity, _values(b"".join(parts))

    def _follow(self, page: int, left: int, parts: list[bytes]) -> None:
        """Adds the rest of a row, which is in overflow pages."""
        if not 0 < page < 1 << 31:
            raise ValueError(page)
        while left > 0:
            start = (page - 1) * self._size
            if page == 0 or start + self._size > len(self._data):
                raise _Missing
            taken = min(left, self._usable - 4)
            parts.append(self._data[start + 4 : start + 4 + taken])
            left -= taken
            page = int.from_bytes(self._data[start : start + 4], "big")


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

_CHUNK, _CONNECTION, _MESSAGE, _INDEX = b"\x05", b"\x07", b"\x02", b"\x04"
_USEFUL = re.compile(rb"\x04\x00\x00\x00op=[\x02\x05\x07]")
"""The field of a header of a chunk, a connection, or a message."""
_MAX_HEADER = 1 << 16
_FIELDS_BEFORE = 256
"""Bytes of a header before that field, at most: where a record begins is looked for within them."""
_IN_FILE = -1
"""In place of a chunk: the message lies outside of chunks."""


class DamagedRos1Bag(DamagedFile):
    """Records of a ROS 1 bag; behind a broken one the next that is whole is looked for."""

    encoding = "ros1"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._chunks: dict[int, tuple[bytes, int]] = {}
        """By the place of its content: compression and size."""
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        lately_broken = False
        behind, skipped = len(ROS1_START), 0
        for at, fields, begin, size, whole in _records(self._data, len(ROS1_START)):
            op = fields["op"]
            skipped, behind = skipped + at - behind, begin + size if whole else begin
            if op == _CHUNK:
                self._chunks[begin] = fields.get("compression", b"none"), size
                lately_broken = not self._take_chunk(begin)
            elif op == _INDEX:
                self.lost += lately_broken * int.from_bytes(fields.get("count", b""), "little")
            else:
                self._take(fields, self._data[begin : begin + size], whole, (_IN_FILE, begin, size))
        if skipped := skipped + len(self._data) - behind:
            self.notes.append(f"{skipped:,} of its {len(self._data):,} bytes are no whole records")
        self._settle()

    def _take_chunk(self, begin: int) -> bool:
        """Takes the messages of a chunk; returns whether it could be unpacked."""
        try:
            inner = self._unpacked(begin)
        except (OSError, RuntimeError, EOFError, ValueError) as error:
            compression = self._chunks[begin][0].decode("latin-1")
            self.notes.append(f"the {compression} chunk at byte {begin} cannot be unpacked: {error}")
            return False
        for _, fields, at, size, whole in _records(inner, 0):
            self._take(fields, inner[at : at + size], whole, (begin, at, size))
        return True

    def _take(self, fields: dict[str, bytes], content: bytes, whole: bool, place: tuple[int, int, int]) -> None:
        number = int.from_bytes(fields.get("conn", b""), "little")
        if fields["op"] == _CONNECTION and whole and "topic" in fields:
            about = dict(_fields(content))
            kind = about.get("type", b"").decode("utf-8", "replace")
            schema = SchemaText(kind, "ros1msg", about.get("message_definition", b""))
            name = fields["topic"].decode("utf-8", "replace")
            self._about.setdefault(number, (name, schema, "", about.get("latching") == b"1"))
        elif fields["op"] == _MESSAGE:
            time = fields.get("time", b"")
            if not (whole and number in self._about and len(time) == 8):
                self.lost += 1
                return
            seconds, nanoseconds = struct.unpack("<II", time)
            self._add(seconds * 10**9 + nanoseconds, number, *place)

    def _read(self, *place: int) -> bytes:
        chunk, at, size = place
        return bytes((self._data if chunk == _IN_FILE else self._unpacked(chunk))[at : at + size])

    def _unpacked(self, begin: int) -> bytes:
        """The records of a chunk, as far as it goes."""
        if begin in self._kept:
            self._kept.move_to_end(begin)
            return self._kept[begin]
        compression, size = self._chunks[begin]
        content = self._data[begin : begin + size]
        if compression == b"bz2":
            content = bz2.BZ2Decompressor().decompress(content)
        elif compression == b"lz4":
            from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

            content = bytes(LZ4FrameDecompressor().decompress(content))
        self._kept[begin] = content
        while len(self._kept) > KEPT_CHUNKS:
            self._kept.popitem(last=False)
        return content


def _records(data: Any, at: int) -> Iterator[tuple[int, dict[str, bytes], int, int, bool]]:
    """(place, header fields, where the content begins, its size, whether it is whole) of records one after the other.

    Behind one that is broken or reaches beyond the end, the search goes on within it.
    """
    end = len(data)
    while at + 8 <= end:
        fields, begin = _header(data, at)
        size = int.from_bytes(data[begin : begin + 4], "little") if fields else 0
        whole = bool(fields) and size <= MAX_PAYLOAD and begin + 4 + size <= end
        packed = fields.get("compression", b"none") != b"none"
        if whole or (fields and (fields["op"] == _MESSAGE or packed)):
            yield at, fields, begin + 4, min(size, end - begin - 4), whole
        at = begin + 4 + size if whole else _next_record(data, (begin if fields else at) + 1)


def _header(data: Any, at: int) -> tuple[dict[str, bytes], int]:
    """The fields of a record's header, none where there is no record, and the place behind it."""
    length = int.from_bytes(data[at : at + 4], "little")
    begin = at + 4 + length
    if not 0 < length <= _MAX_HEADER or begin + 4 > len(data):
        return {}, at
    fields = dict(_fields(data[at + 4 : begin]))
    whole = sum(len(name) + len(value) + 5 for name, value in fields.items()) == length
    return (fields, begin) if whole and "op" in fields else ({}, at)


def _next_record(data: Any, at: int) -> int:
    """The place of the next record that is of use; that of the end where there is none."""
    while (found := _USEFUL.search(data, at)) is not None:
        for start in range(found.start() - 4, max(at, found.start() - _FIELDS_BEFORE) - 1, -1):
            if _header(data, start)[0]:
                return start
        at = found.end()
    return len(data)


def _fields(header: bytes) -> Iterator[tuple[str, bytes]]:
    at = 0
    while at + 4 <= len(header):
        length = int.from_bytes(header[at : at + 4], "little")
        name, separator, value = header[at + 4 : at + 4 + length].partition(b"=")
        if separator:
            yield name.decode("latin-1"), value
        at += 4 + length
