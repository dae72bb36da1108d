"""The producer's side of shared memory: a pool of blocks, and what its consumers have released.

Blocks are cut from the pool best-fit and come back to it, merged with their neighbours, when it is used up: so no size
of message can keep the pool from the others for longer than its messages are held.

A large array of a message is made in a block at once (`room`), behind room for what goes before it in an envelope: what
is sent first from there is not copied again.
"""

from __future__ import annotations

import mmap
import os
import secrets
import threading
import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import msgpack
import numpy as np
import numpy.typing as npt

from dataflow.transport.envelope import MAGIC, PRELUDE, VERSION, Buffer, Kind
from dataflow.transport.shared import POOL_NAME, SLOTS, make_memory, protect

SCAN_AT_MOST: Final = 16
BEFORE: Final = 4096
"""Bytes in front of an array that is made in a block, for the head and body of its envelope."""
_HELD_HERE: Final = 4
"""At most the pool's bytes by this are arrays that its own process holds: the rest is there for what is to be sent."""
_SMALLEST: Final = 64 << 10
_pack: Final = msgpack.Packer(autoreset=True).pack


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
    start: int = 0
    """The place in the pool at which its envelope begins."""

    def free(self) -> bool:
        for claim in self.claims:  # noqa: SIM110 - no generator: a large message asks this
            if not claim.released(self.slot, self.generation):
                return False
        return True


class _Array(weakref.ref["npt.NDArray[np.uint8]"]):
    """Claims a block for an array of a message that lies in it, for as long as this process holds the array."""

    __slots__ = ("block", "gone", "key", "sent")
    block: Block
    key: int
    gone: bool
    sent: bool
    """An envelope lies in front of it: another one would be written over that."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__

    def released(self, slot: int, generation: int) -> bool:
        return self.gone

    def mapped(self, base: int) -> bool:
        return True


class SharedPool:
    """The blocks of one producing process; on any thread."""

    def __init__(self, size: int) -> None:
        """Makes the memory, of which pages are taken as they are first used; raises `SharedMemoryError`."""
        self.size = size
        self.id = secrets.token_hex(8)
        self.base = secrets.randbits(62) | 1
        self._generation = self.base
        self._pid = os.getpid()
        self._descriptor = make_memory(POOL_NAME + self.id, size)
        self._memory = mmap.mmap(self._descriptor, size)
        self._view = memoryview(self._memory)
        protect(self._descriptor)
        self._gaps: list[tuple[int, int]] = [(0, size)]
        """(offset, bytes) of what belongs to no block, by offset; no two touch."""
        self._slots = list(range(SLOTS - 1, -1, -1))
        self._out: dict[int, deque[Block]] = {}
        """Blocks by capacity, the oldest first; some may have been released."""
        self._lock = threading.Lock()
        self._closed = False
        self._arrays: dict[int, _Array] = {}
        """Arrays that lie here, by their ids."""
        self._here = 0
        self._let_go: deque[int] = deque()
        """Bytes of blocks whose arrays are held by this process, and of those that it has let go of since."""

    def room(self, nbytes: int) -> npt.NDArray[np.uint8] | None:
        """Returns memory to make an array on, held until the last view of it is gone; None when there is none. Never
        waits: None, too, while another thread is at the pool, or this one, whose work a finaliser interrupts."""
        capacity = _capacity(BEFORE + nbytes)
        if not self._lock.acquire(blocking=False):
            return None
        try:
            while self._let_go:
                self._here -= self._let_go.popleft()
            fits = self._here + capacity <= self.size // _HELD_HERE and not self._closed
            block = self._take(capacity) if fits else None
            if block is None:
                return None
            self._here += capacity
            array: npt.NDArray[np.uint8] = np.ndarray((nbytes,), np.uint8, self._memory, block.offset + BEFORE)
            claim = _Array(array, self._let_array_go)
            claim.block, claim.key, claim.gone, claim.sent = block, id(array), False, False
            self._arrays[claim.key] = claim
            block.claims = (claim,)
            self._out.setdefault(capacity, deque()).append(block)
            return array
        finally:
            self._lock.release()

    def _let_array_go(self, claim: _Array) -> None:
        """Releases an array that nothing here holds. Called at any moment on any thread, so without the lock."""
        del self._arrays[claim.key]
        claim.gone = True
        self._let_go.append(claim.block.capacity)

    def write(self, parts: Sequence[Buffer], size: int, claims: tuple[Claim, ...]) -> Block | None:
        """Puts an envelope of `size` bytes, given as consecutive buffers, into a block; None when there is no room."""
        with self._lock:
            claim = self._array_in(parts[-1])
            before = size - len(parts[-1])
            if claim is not None and before <= BEFORE:
                claim.sent = True
                block, parts, claims = claim.block, parts[:-1], (claim, *claims)
                block.start = block.offset + BEFORE - before
            else:
                taken = self._take(_capacity(size))
                if taken is None:
                    return None
                block = taken
                block.start = block.offset
                self._out.setdefault(block.capacity, deque()).append(block)
            offset = block.start
            for part in parts:
                self._view[offset : offset + len(part)] = part
                offset += len(part)
            self._generation += 1
            block.generation, block.claims = self._generation, claims
        return block

    def _array_in(self, part: Buffer) -> _Array | None:
        """Returns the claim of the array that is this part of an envelope, if it lies here and was not sent yet."""
        given = getattr(getattr(part, "obj", None), "base", None)  # part → array of the message → memory of `room`
        claim = self._arrays.get(id(given))
        return None if claim is None or claim.sent or claim() is not given else claim

    def reference(self, head: bytes, block: Block, size: int) -> bytes:
        """Makes the envelope that stands for the one in `block`."""
        body: bytes = _pack(
            (self.id, self.base, self._pid, self._descriptor, block.start, size, block.slot, block.generation)
        )
        return PRELUDE.pack(MAGIC, VERSION, Kind.REFERENCE, len(head), len(body)) + head + body

    def free(self) -> int:
        """Returns how many bytes are free."""
        with self._lock:
            released = sum(b.capacity for blocks in self._out.values() for b in blocks if b.free())
            return released + sum(length for _, length in self._gaps)

    def consumers(self) -> set[Claim]:
        """Returns the holders of blocks."""
        with self._lock:
            return {c for blocks in self._out.values() for b in blocks for c in b.claims if not b.free()}

    def close(self) -> None:
        """Gives the memory back. Consumers that have mapped it keep what they hold, as do holders of arrays here."""
        with self._lock:
            self._closed = True
            self._view.release()
            del self._memory
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
