"""The latest firing records of one process, in memory that outlives it.

The supervisor makes the memory (a memfd), hands it down at the fork, and reads it only after the process has died: a
record costs no system call and does not pass through the supervisor. Two segments are written in turn. Each begins with
a checkpoint (where every operator had got to), so the older one may be overwritten: the rest still holds the position
of each operator, and at least one segment's worth of records. A frame counts once its segment's length includes it,
and the length is written last; so a kill at any instruction leaves whole frames.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from typing import Any

import msgpack

from dataflow.records.firing import WITHHELD, FiringRecord, decode_batch, encode_single

SEGMENT = 1 << 20
"""Bytes of one segment at first; one that must hold a larger record (a snapshot of a map) grows. Unused pages cost
nothing."""
_HEADER = 4096
_FRAME = struct.Struct("<IB")
_RECORD, _CHECKPOINT = 0, 1
_GENERATION, _OFFSET, _CAPACITY, _LENGTH = range(4)


@dataclass(slots=True)
class OperatorProgress:
    """Holds where an operator has got to by its firing records: its incarnation, the last stamp (ns) of each port, the
    parameters that were changed, and the place (incarnation, number) of the next message of each port."""

    incarnation: int = 0
    last: dict[str, int] = field(default_factory=dict)
    changed: dict[str, Any] = field(default_factory=dict)
    places: dict[str, tuple[int, int]] = field(default_factory=dict)

    def take(self, record: FiringRecord, ports: Sequence[str]) -> None:
        """Goes on by the next record; `ports` are the operator's outputs as declared."""
        kind = record.kind
        if kind == "reset":
            self.last.clear()
        elif kind == "param":
            self.changed[record.detail["name"]] = record.detail["value"]
        if record.incarnation > self.incarnation:
            self.incarnation = record.incarnation
        for port, emission in zip(ports, record.outputs, strict=False):
            if emission is not None and emission.seq != WITHHELD and kind != "setup":
                self.last[port] = emission.stamp
                self.places[port] = record.incarnation, emission.seq + 1


class BlackBox:
    """The writer's end, in the process whose records are kept.

    `ports` are the output ports of each operator as declared. `reached` is where operators that take the place of
    others had got to.
    """

    def __init__(
        self, descriptor: int, ports: Mapping[str, Sequence[str]], reached: Mapping[str, OperatorProgress] | None = None
    ) -> None:
        self._descriptor, self._ports = descriptor, ports
        self._reached = {name: OperatorProgress() for name in ports} | dict(reached or {})
        self._memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size)
        self._words = memoryview(self._memory)[:_HEADER].cast("Q")
        self._active = 0
        self._base, self._room = _HEADER, SEGMENT
        self._length = 0
        self._begin(0, generation=1, least=0)

    def add(self, record: FiringRecord) -> None:
        """Keeps a record, and notes where its operator has got to."""
        self.keep(record)
        self.note(record)

    def keep(self, record: FiringRecord) -> None:
        """Keeps a record; to be called before the messages of its firing are sent. `note` follows before the next."""
        data = encode_single(record)
        if self._length + _FRAME.size + len(data) > self._room:
            self._begin(1 - self._active, self._words[4 * self._active + _GENERATION] + 1, least=len(data))
        self._append(_RECORD, data)

    def note(self, record: FiringRecord) -> None:
        """Notes an operator's position by a record that is kept, for the next checkpoint."""
        self._reached[record.operator].take(record, self._ports[record.operator])

    def kept(self, operator: str) -> list[FiringRecord]:
        """Returns the latest records of an operator, in order."""
        batches = read_black_box(self._descriptor, self._ports).batches[operator]
        return [record for data in batches for record in decode_batch(data).records]

    def close(self) -> None:
        """Unmaps the memory; the supervisor's descriptor keeps what it holds."""
        self._words.release()
        self._memory.close()

    def _begin(self, segment: int, generation: int, *, least: int) -> None:
        """Begins to write a segment anew, with a checkpoint; enlarges it so that `least` bytes fit behind that."""
        checkpoint: bytes = msgpack.packb({n: list(astuple(r)) for n, r in self._reached.items()})
        needed = 2 * _FRAME.size + len(checkpoint) + least
        words, first = self._words, 4 * segment
        words[first + _LENGTH] = 0
        if words[first + _CAPACITY] < needed:
            self._enlarge(segment, needed)
            words = self._words
        words[first + _GENERATION] = generation
        self._active, self._length = segment, 0
        self._base, self._room = words[first + _OFFSET], words[first + _CAPACITY]
        self._append(_CHECKPOINT, checkpoint)

    def _append(self, kind: int, data: bytes) -> None:
        at = self._base + self._length
        _FRAME.pack_into(self._memory, at, len(data), kind)
        start = at + _FRAME.size
        self._memory[start : start + len(data)] = data
        self._length += _FRAME.size + len(data)
        self._words[4 * self._active + _LENGTH] = self._length

    def _enlarge(self, segment: int, needed: int) -> None:
        """Moves a segment to the end of the memory, at twice the room that is needed, and gives its old pages back."""
        first = 4 * segment
        before, size = self._words[first + _OFFSET], self._words[first + _CAPACITY]
        capacity = _whole_pages(2 * needed)
        offset = os.fstat(self._descriptor).st_size
        os.ftruncate(self._descriptor, offset + capacity)
        self.close()
        self._memory = mmap.mmap(self._descriptor, offset + capacity)
        self._words = memoryview(self._memory)[:_HEADER].cast("Q")
        self._words[first + _CAPACITY] = 0  # nothing is read from it until both are right
        self._words[first + _OFFSET] = offset
        self._words[first + _CAPACITY] = capacity
        self._memory.madvise(mmap.MADV_REMOVE, before, size)


@dataclass(frozen=True, slots=True)
class RecoveredRecords:
    """Holds what a dead process left: its operators' latest records as batches of one, and where each had got to."""

    batches: Mapping[str, Sequence[bytes]]
    reached: Mapping[str, OperatorProgress]


def make_black_box() -> int:
    """Makes the memory, for one process; returns its descriptor, which that process inherits."""
    descriptor = os.memfd_create("firing-records")
    os.ftruncate(descriptor, _HEADER + 2 * SEGMENT)
    for segment in range(2):
        words = struct.pack("<4Q", 0, _HEADER + segment * SEGMENT, SEGMENT, 0)
        os.pwrite(descriptor, words, 32 * segment)
    return descriptor


def read_black_box(descriptor: int, ports: Mapping[str, Sequence[str]]) -> RecoveredRecords:
    """Reads what a process left that has died, or that had not begun to write."""
    batches: dict[str, list[bytes]] = {name: [] for name in ports}
    reached = {name: OperatorProgress() for name in ports}
    for kind, data in _frames(descriptor):
        if kind == _CHECKPOINT:
            for name, (incarnation, last, changed, places) in msgpack.unpackb(data).items():
                reached[name] = OperatorProgress(
                    incarnation, last, changed, {port: tuple(p) for port, p in places.items()}
                )
            continue
        for record in decode_batch(data).records:
            batches[record.operator].append(data)
            reached[record.operator].take(record, ports[record.operator])
    return RecoveredRecords(batches, reached)


def _frames(descriptor: int) -> Iterator[tuple[int, bytes]]:
    header = os.pread(descriptor, 64, 0)
    segments = sorted(struct.unpack_from("<4Q", header, 32 * k) for k in range(2))
    for generation, offset, _, length in segments:
        if not generation:
            continue
        content = os.pread(descriptor, length, offset)
        at = 0
        while at < length:
            size, kind = _FRAME.unpack_from(content, at)
            at += _FRAME.size
            yield kind, content[at : at + size]
            at += size


def _whole_pages(size: int) -> int:
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
