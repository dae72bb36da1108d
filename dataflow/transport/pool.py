"""The producer's side of shared memory: a pool of blocks, and what its consumers have released.

Blocks are cut from the pool best-fit and come back to it, merged with their neighbours, when it is used up: so no size
of message can keep the pool from the others for longer than its messages are held.
"""

from __future__ import annotations

import mmap
import os
import secrets
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import msgpack

from dataflow.transport.envelope import MAGIC, PRELUDE, VERSION, Buffer, Kind
from dataflow.transport.shared import POOL_NAME, SLOTS, make_memory, protect

SCAN_AT_MOST: Final = 16
_SMALLEST: Final = 64 << 10


class Claim(Protocol):
    """A consumer that a block was sent to."""

    def released(self, slot: int, generation: int) -> bool:
        """Returns whether the consumer no longer uses what `generation` put into `slot`."""

    def mapped(self, base: int) -> bool:
        """Returns whether the consumer has mapped the pool whose generations begin at `base` (or has ended)."""


@dataclass(slots=True, eq=False)
class Block:
    """A piece of the pool that holds one envelope until all of `claims` have released it."""

    slot: int
    offset: int
    capacity: int
    generation: int = 0
    claims: tuple[Claim, ...] = ()

    def free(self) -> bool:
        return all(c.released(self.slot, self.generation) for c in self.claims)


class SharedPool:
    """The blocks of one producing process. Not thread-safe."""

    def __init__(self, size: int) -> None:
        """Makes the memory, of which pages are taken as they are first used; raises `SharedMemoryError`."""
        self.size = size
        self.id = secrets.token_hex(8)
        self.base = secrets.randbits(62) | 1
        self._generation = self.base
        self._descriptor = make_memory(POOL_NAME + self.id, size)
        self._memory = mmap.mmap(self._descriptor, size)
        self._view = memoryview(self._memory)
        protect(self._descriptor)
        self._gaps: list[tuple[int, int]] = [(0, size)]
        """(offset, bytes) of what belongs to no block, by offset; no two touch."""
        self._slots = list(range(SLOTS - 1, -1, -1))
        self._out: dict[int, deque[Block]] = {}
        """Blocks by capacity, the oldest first; some may have been released."""

    def write(self, parts: Sequence[Buffer], size: int, claims: tuple[Claim, ...]) -> Block | None:
        """Puts an envelope of `size` bytes, given as consecutive buffers, into a block; None when there is no room."""
        block = self._take(_capacity(size))
        if block is None:
            return None
        offset = block.offset
        for part in parts:
            self._view[offset : offset + len(part)] = part
            offset += len(part)
        self._generation += 1
        block.generation, block.claims = self._generation, claims
        self._out.setdefault(block.capacity, deque()).append(block)
        return block

    def reference(self, head: bytes, block: Block, size: int) -> bytes:
        """Makes the envelope that stands for the one in `block`."""
        body: bytes = msgpack.packb(
            (self.id, self.base, os.getpid(), self._descriptor, block.offset, size, block.slot, block.generation)
        )
        return PRELUDE.pack(MAGIC, VERSION, Kind.REFERENCE, len(head), len(body)) + head + body

    def free(self) -> int:
        """Returns how many bytes belong to nobody now."""
        released = sum(b.capacity for blocks in self._out.values() for b in blocks if b.free())
        return released + sum(length for _, length in self._gaps)

    def consumers(self) -> set[Claim]:
        """Returns those who hold blocks."""
        return {c for blocks in self._out.values() for b in blocks for c in b.claims if not b.free()}

    def close(self) -> None:
        """Gives the memory back. Consumers that have mapped it keep what they hold."""
        self._view.release()
        self._memory.close()
        os.close(self._descriptor)

    def _take(self, capacity: int) -> Block | None:
        """Finds a block: one of this size that was released, memory not used yet, or what others have released."""
        out = self._out.get(capacity)
        for _ in range(min(SCAN_AT_MOST, len(out)) if out else 0):
            assert out is not None
            block = out.popleft()
            if block.free():
                return block
            out.append(block)
        found = self._cut(capacity)
        if found is None and self._dissolve_released():
            found = self._cut(capacity)
        return found

    def _cut(self, capacity: int) -> Block | None:
        """Cuts a block from the smallest gap that it fits into."""
        fitting = [(length, number) for number, (_, length) in enumerate(self._gaps) if length >= capacity]
        if not fitting or not self._slots:
            return None
        length, number = min(fitting)
        offset = self._gaps[number][0]
        self._gaps[number : number + 1] = [(offset + capacity, length - capacity)] if length > capacity else []
        return Block(self._slots.pop(), offset, capacity)

    def _dissolve_released(self) -> bool:
        """Makes gaps of all blocks that were released; False when there were none."""
        gone: list[Block] = []
        for capacity, blocks in self._out.items():
            released = [b for b in blocks if b.free()]
            if released:
                gone += released
                kept = set(blocks) - set(released)
                self._out[capacity] = deque(b for b in blocks if b in kept)
        self._slots += [b.slot for b in gone]
        merged: list[tuple[int, int]] = []
        for offset, length in sorted([*self._gaps, *((b.offset, b.capacity) for b in gone)]):
            if merged and sum(merged[-1]) == offset:
                merged[-1] = (merged[-1][0], merged[-1][1] + length)
            else:
                merged.append((offset, length))
        self._gaps = merged
        return bool(gone)


def _capacity(size: int) -> int:
    """Rounds up to a block size: the next of 64, 96, 128, 192, 256, ... KiB."""
    whole = max(_SMALLEST, 1 << (size - 1).bit_length())
    return whole * 3 // 4 if size <= whole * 3 // 4 and whole > _SMALLEST else whole
