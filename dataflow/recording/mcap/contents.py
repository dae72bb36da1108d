"""Contents of an MCAP file and their places, gathered record by record from its summary or by a pass."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from dataflow.recording.limits import BYTES_PER_RECORD, MAX_PARSED, UNINDEXED_RECORDS
from dataflow.recording.mcap.attachments import Place
from dataflow.recording.mcap.chunks import Chunks
from dataflow.recording.mcap.rawfile import RECORD, RawFile

UNCHUNKED = -1
MESSAGE_BODY = struct.Struct("<HIQQ")
_ID = struct.Struct("<H")
_INDEX = struct.Struct("<HI")
_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


@dataclass(frozen=True, slots=True)
class Entries:
    """The messages of one channel in file order: log time (ns), chunk number or UNCHUNKED, offset in it or the file."""

    times: npt.NDArray[np.int64]
    chunks: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)

    @property
    def columns(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Times, chunks and offsets."""
        return self.times, self.chunks, self.offsets

    @classmethod
    def joined(cls, parts: Iterable[Entries]) -> Entries:
        """Parts one behind the other."""
        return cls(*map(np.concatenate, zip(*(part.columns for part in (NO_ENTRIES, *parts)), strict=True)))

    def where(self, kept: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Entries:
        """Those of them that are to be kept, by a mask or by their places."""
        return Entries(self.times[kept], self.chunks[kept], self.offsets[kept])


NO_ENTRIES = Entries(*(np.empty(0, np.int64) for _ in range(3)))


@dataclass(slots=True)
class _Growing:
    times: array[int] = field(default_factory=lambda: array("q"))
    chunks: array[int] = field(default_factory=lambda: array("q"))
    offsets: array[int] = field(default_factory=lambda: array("q"))

    def add(self, time: int, chunk: int, offset: int) -> None:
        self.times.append(time)
        self.chunks.append(chunk)
        self.offsets.append(offset)

    def extend(self, entries: Entries) -> None:
        for mine, more in zip((self.times, self.chunks, self.offsets), entries.columns, strict=True):
            mine.frombytes(more.tobytes())

    def done(self) -> Entries:
        columns = (self.times, self.chunks, self.offsets)
        return Entries(*(np.frombuffer(c, np.int64) if len(c) else np.empty(0, np.int64) for c in columns))


class Contents:
    """Findings so far.

    `damage`: notes of what was damaged and got round; `left_out`: chunks that cannot be read; `loose_bytes`: data of
    messages outside chunks, by channel.
    """

    def __init__(self, file: RawFile, chunks: Chunks | None = None) -> None:
        self.file = file
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.attachments: list[Place] = []
        self.chunks = chunks or Chunks(file)
        self.damage: list[str] = []
        self.left_out = 0
        self.loose_bytes: dict[int, int] = {}
        self._growing: dict[int, _Growing] = {}
        self._declared: dict[tuple[int, int], bytes] = {}
        self._parsed = self._walked = 0

    def entries(self) -> dict[int, Entries]:
        """The messages found, by channel."""
        return {channel: growing.done() for channel, growing in self._growing.items()}

    def counts(self) -> dict[int, int]:
        """Returns how many messages were found, by channel."""
        return {channel: len(growing.times) for channel, growing in self._growing.items()}

    def undeclared(self) -> list[int]:
        """Channels of messages that no channel record describes."""
        return sorted(self._growing.keys() - self.channels.keys())

    def count_parsed(self, offset: int) -> None:
        """Bounds the work of opening a file: one more record is to be parsed."""
        self._parsed += 1
        if self._parsed > MAX_PARSED:
            raise self.file.damaged(f"the record at byte {offset} is beyond the {MAX_PARSED} that are read")

    def declare(self, opcode: int, body: bytes, offset: int) -> None:
        """Takes a schema or a channel; one that comes again must be the same."""
        (number,) = _ID.unpack_from(body)
        known = self._declared.get((opcode, number))
        if known is not None:
            if known != body:
                raise self.file.damaged(f"the record at byte {offset} declares {number} otherwise than one before")
            return
        self.count_parsed(offset)
        self._declared[opcode, number] = body
        if opcode == Opcode.SCHEMA:
            self.schemas[number] = self.file.parse(Schema, body, offset)
        else:
            self.channels[number] = self.file.parse(Channel, body, offset)

    def add_metadata(self, body: bytes, offset: int) -> None:
        """Takes one more metadata record."""
        self.count_parsed(offset)
        self.take_metadata(body, offset)

    def take_metadata(self, body: bytes, offset: int) -> None:
        """Takes a metadata record that is counted already."""
        record = self.file.parse(Metadata, body, offset)
        self.metadata.append((record.name, record.metadata))

    def add_attachment(self, place: Place) -> None:
        """Takes the place of an attachment, which is not read."""
        self.count_parsed(place.offset)
        self.attachments.append(place)

    def add_loose_message(self, offset: int, length: int) -> None:
        """Takes a message that lies outside chunks, its body of `length` bytes."""
        self._count_walked(offset)
        body = self.file.near(offset + RECORD.size, MESSAGE_BODY.size)
        channel, _, log_time, _ = MESSAGE_BODY.unpack(body)
        self._entries_of(channel).add(signed(log_time), UNCHUNKED, offset)
        self.loose_bytes[channel] = self.loose_bytes.get(channel, 0) + length - MESSAGE_BODY.size

    def add_indexes(self, chunk: int, indexes: list[bytes]) -> bool:
        """Takes a chunk's messages from the bodies of its message indexes; False, and nothing, where they are wrong."""
        found: dict[int, npt.NDArray[Any]] = {}
        for body in indexes:
            if len(body) < _INDEX.size:
                return False
            channel, length = _INDEX.unpack_from(body)
            if length % _ENTRY.itemsize or _INDEX.size + length > len(body) or channel in found:
                return False
            entries = np.frombuffer(body, _ENTRY, length // _ENTRY.itemsize, _INDEX.size)
            if len(entries) and int(entries["offset"].max()) >= self.chunks.ref(chunk).uncompressed_size:
                return False
            found[channel] = entries
        columns = {c: (e["time"].astype(np.int64), e["offset"].astype(np.int64)) for c, e in found.items()}
        self.add_entries({c: Entries(times, np.full_like(times, chunk), at) for c, (times, at) in columns.items()})
        return True

    def add_entries(self, found: Mapping[int, Entries]) -> None:
        """Takes messages by channel, all of them sound."""
        for channel, entries in found.items():
            self._entries_of(channel).extend(entries)

    def take_chunk(self, number: int) -> None:
        """Takes a chunk's messages, schemas and channels from its content."""
        data = self.chunks.data(number)
        where = self.chunks.where(number)
        size, unpack, message = len(data), RECORD.unpack_from, MESSAGE_BODY
        position = 0
        while position < size:
            if position + RECORD.size > size:
                raise self.file.damaged(f"{where} ends within a record")
            opcode, length = unpack(data, position)
            start = position + RECORD.size
            if opcode == 0 or start + length > size:
                raise self.file.damaged(f"{where} has no whole record at its byte {position}")
            self._count_walked(self.chunks.ref(number).offset)
            if opcode == Opcode.MESSAGE:
                if length < message.size:
                    raise self.file.damaged(f"{where} has a message of {length} bytes at its byte {position}")
                channel, _, log_time, _ = message.unpack_from(data, start)
                self._entries_of(channel).add(signed(log_time), number, position)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.declare(opcode, data[start : start + length], self.chunks.ref(number).offset)
            position = start + length

    def _count_walked(self, offset: int) -> None:
        self._walked += 1
        most = UNINDEXED_RECORDS + self.file.size // BYTES_PER_RECORD
        if self._walked > most:
            raise self.file.damaged(
                f"by byte {offset} there were more than the {most} records that are read without an index"
            )

    def _entries_of(self, channel: int) -> _Growing:
        return self._growing.setdefault(channel, _Growing())


def signed(log_time: int) -> int:
    return log_time if log_time < 2**63 else log_time - 2**64
