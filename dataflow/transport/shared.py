"""Shared memory between hosts of one machine: a large envelope is written once, and every consumer reads it in place.

The memory is anonymous (memfd), so nothing is left behind however a process ends. A publisher owns a pool of blocks;
what travels on the stream is a reference to one. A consumer maps the pool read-only, and notes on a *board*, memory of
its own that the publisher reads, which block it no longer uses: every byte has one writer, and a block is used again
only when all its consumers have let go of it (or their processes have ended). Linux only; elsewhere envelopes travel
whole.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import secrets
import sys
import threading
import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np
import psutil  # type: ignore[import-untyped]

from dataflow.transport.codec import MAGIC, PRELUDE, VERSION, Buffer, DecodeError, Kind

SUPPORTED: Final = sys.platform == "linux" and hasattr(os, "memfd_create")
THRESHOLD = 32 << 10
"""Envelopes of fewer bytes travel whole: below it a reference is not faster (benchmarks/transport.md)."""

SLOTS: Final = 4096
BOARD_BYTES: Final = 8 * (SLOTS + 1)
SCAN_AT_MOST = 16
_SMALLEST: Final = 64 << 10
_SEAL_FUTURE_WRITE: Final = 0x0010  # Linux 5.1; not in Python 3.11's fcntl
_POOL_NAME = "dataflow-pool-"
_BOARD_NAME = "dataflow-board-"


class SharedMemoryError(RuntimeError):
    """A pool or board that cannot be made or opened: says which and why."""


def machine() -> str:
    """Names this machine, process namespace and user: processes with equal names can share memory."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    namespace = os.readlink("/proc/self/ns/pid").strip("pid:[]")
    return f"{boot}.{namespace}.{os.getuid()}"


def _make(name: str, size: int) -> int:
    try:
        descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, size)
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
    except OSError as error:
        raise SharedMemoryError(
            f"cannot make shared memory of {size} bytes: {error.strerror}; raise the limit of memory or of file sizes "
            "(ulimit -f), or do without: network: {shared_memory: false}"
        ) from error
    return descriptor


def _protect(descriptor: int) -> None:
    """From here on only the mappings that exist may write."""
    try:
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEAL_FUTURE_WRITE)
    except OSError:  # an older kernel: the others map read-only by agreement
        return


def _open(pid: int, descriptor: int, name: str) -> mmap.mmap:
    """Another process's shared memory, mapped read-only; raises `SharedMemoryError` unless it is the one named."""
    path = f"/proc/{pid}/fd/{descriptor}"
    try:
        if not os.readlink(path).startswith(f"/memfd:{name}"):
            raise SharedMemoryError(f"{path} is not {name!r}")
        own = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            if not fcntl.fcntl(own, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
                raise SharedMemoryError(f"{path}: its owner could truncate it")
            return mmap.mmap(own, 0, prot=mmap.PROT_READ)
        finally:
            os.close(own)
    except (OSError, ValueError) as error:
        raise SharedMemoryError(f"cannot open the shared memory {path}: {error}") from error


# The publisher's side


class BoardReader:
    """A consumer as its publisher sees it: what it has let go of, and whether its process still runs."""

    def __init__(self, pid: int, descriptor: int, key: str) -> None:
        """Raises `SharedMemoryError` when the consumer's board cannot be opened."""
        self.key = key
        self.lost = False
        """Set when its liveliness token is gone: then its process is asked for."""
        try:
            self._process = psutil.Process(pid)
        except psutil.Error as error:
            raise SharedMemoryError(f"board of process {pid}: {error}") from error
        memory = _open(pid, descriptor, _BOARD_NAME)
        if len(memory) != BOARD_BYTES:
            raise SharedMemoryError(f"board of process {pid}: {len(memory)} bytes, expected {BOARD_BYTES}")
        self._cells = memoryview(memory).cast("Q")

    def released(self, slot: int, generation: int) -> bool:
        return self._cells[slot] == generation or (self.lost and not self._runs())

    def mapped(self, base: int) -> bool:
        """Whether the consumer has mapped the pool whose generations begin at `base` (or has ended)."""
        return self._cells[SLOTS] == base or not self._runs()

    def _runs(self) -> bool:
        try:
            return bool(self._process.is_running() and self._process.status() != psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return False


@dataclass(slots=True)
class Block:
    """A piece of the pool that holds one envelope until all of `claims` have let go of it."""

    slot: int
    offset: int
    capacity: int
    generation: int = 0
    claims: tuple[BoardReader, ...] = ()

    def free(self) -> bool:
        return all(c.released(self.slot, self.generation) for c in self.claims)


class SharedPool:
    """The blocks of one publishing process. Not thread-safe: the bus holds its lock around every call."""

    def __init__(self, size: int) -> None:
        """Raises `SharedMemoryError`. Memory is taken as it is first used, up to `size` bytes."""
        self.size = size
        self.id = secrets.token_hex(8)
        self.base = secrets.randbits(62) | 1
        self._generation = self.base
        self._descriptor = _make(_POOL_NAME + self.id, size)
        self._memory = mmap.mmap(self._descriptor, size)
        self._view = memoryview(self._memory)
        _protect(self._descriptor)
        self._used = 0
        self._slots = 0
        self._free: dict[int, list[Block]] = {}
        self._out: dict[int, deque[Block]] = {}

    def write(self, parts: Sequence[Buffer], size: int, claims: tuple[BoardReader, ...]) -> Block | None:
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
        """The envelope that stands for the one in `block`."""
        body: bytes = msgpack.packb(
            (self.id, self.base, os.getpid(), self._descriptor, block.offset, size, block.slot, block.generation)
        )
        return PRELUDE.pack(MAGIC, VERSION, Kind.REFERENCE, len(head), len(body)) + head + body

    def take_back(self, block: Block) -> None:
        """Frees a block whose reference was not sent."""
        block.claims = ()

    def consumers(self) -> set[BoardReader]:
        """Those who hold blocks."""
        return {c for blocks in self._out.values() for b in blocks for c in b.claims if not b.free()}

    def close(self) -> None:
        """Gives the memory back. Consumers that have mapped it keep what they hold."""
        self._view.release()
        self._memory.close()
        os.close(self._descriptor)

    def _take(self, capacity: int) -> Block | None:
        free = self._free.setdefault(capacity, [])
        if free:
            return free.pop()
        out = self._out.get(capacity)
        for _ in range(min(SCAN_AT_MOST, len(out)) if out else 0):
            assert out is not None
            block = out.popleft()
            if block.free():
                return block
            out.append(block)
        if self._used + capacity <= self.size and self._slots < SLOTS:
            block = Block(self._slots, self._used, capacity)
            self._used += capacity
            self._slots += 1
            return block
        return self._reclaim(capacity)

    def _reclaim(self, capacity: int) -> Block | None:
        """With the pool used up: any free block of this size or, when nothing at all is held, a pool cut anew."""
        found: Block | None = None
        held = False
        for blocks in self._out.values():
            for _ in range(len(blocks)):
                block = blocks.popleft()
                if not block.free():
                    held = True
                    blocks.append(block)
                elif found is None and block.capacity == capacity:
                    found = block
                else:
                    self._free.setdefault(block.capacity, []).append(block)
        if found is not None or held:
            return found
        self._free.clear()
        self._out.clear()
        if capacity > self.size:
            self._used = self._slots = 0
            return None
        self._used, self._slots = capacity, 1
        return Block(0, 0, capacity)


def _capacity(size: int) -> int:
    """The block size for `size` bytes: the next of 64, 96, 128, 192, 256, ... KiB."""
    whole = max(_SMALLEST, 1 << (size - 1).bit_length())
    return whole * 3 // 4 if size <= whole * 3 // 4 and whole > _SMALLEST else whole


# The consumer's side


class Board:
    """What one subscription has let go of. Written here only, read by the publisher."""

    def __init__(self) -> None:
        """Raises `SharedMemoryError`."""
        self.descriptor = _make(_BOARD_NAME + secrets.token_hex(4), BOARD_BYTES)
        self._cells = memoryview(mmap.mmap(self.descriptor, BOARD_BYTES)).cast("Q")
        _protect(self.descriptor)
        self._base = 0

    def mapped(self, base: int) -> None:
        """Notes that the pool whose generations begin at `base` is mapped; an earlier pool no longer counts."""
        if base != self._base:
            self._base = self._cells[SLOTS] = base

    def release(self, base: int, slot: int, generation: int) -> None:
        if base == self._base:
            self._cells[slot] = generation

    def close(self) -> None:
        """Ends the sharing; what is still held is noted in memory that the publisher has mapped."""
        os.close(self.descriptor)


@dataclass(slots=True)
class PoolReader:
    """The pools of other processes, mapped on first use."""

    _pools: dict[str, mmap.mmap] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def resolve(self, payload: bytes, board: Board) -> memoryview:
        """The envelope that a reference stands for, in place and read-only.

        The block is let go of when the last view of it is gone. Raises `SharedMemoryError` when the pool cannot be
        mapped and `DecodeError` for what is no reference.
        """
        _, _, _, head_bytes, body_bytes = PRELUDE.unpack_from(payload)
        fields = _reference(payload[PRELUDE.size + head_bytes :], body_bytes)
        pool_id, base, pid, descriptor, offset, size, slot, generation = fields
        pool = self._map(pool_id, pid, descriptor)
        board.mapped(base)
        if offset + size > len(pool) or slot >= SLOTS or size < PRELUDE.size:
            raise DecodeError(f"reference to {size} bytes at {offset} of a pool of {len(pool)}")
        block = np.frombuffer(pool, np.uint8, size, offset)
        weakref.finalize(block, board.release, base, slot, generation).atexit = False
        return block.data

    def _map(self, pool_id: str, pid: int, descriptor: int) -> mmap.mmap:
        with self._lock:
            found = self._pools.get(pool_id)
            if found is None:
                found = self._pools[pool_id] = _open(pid, descriptor, _POOL_NAME + pool_id)
            return found


def is_reference(payload: bytes) -> bool:
    """Whether the payload is an envelope that stands for one in shared memory."""
    return len(payload) >= PRELUDE.size and payload[:4] == MAGIC and payload[5] == Kind.REFERENCE


def _reference(body: bytes, body_bytes: int) -> tuple[Any, ...]:
    try:
        fields = msgpack.unpackb(body, raw=False, use_list=False, max_array_len=8, max_str_len=16, max_map_len=0)
    except Exception as error:  # msgpack raises a dozen types for malformed input
        raise DecodeError(f"reference: {error}") from None
    if (
        len(body) != body_bytes
        or not isinstance(fields, tuple)
        or len(fields) != 8
        or type(fields[0]) is not str
        or not all(type(f) is int and f >= 0 for f in fields[1:])
    ):
        raise DecodeError("reference: expected [pool id, base, process, descriptor, offset, size, slot, generation]")
    return fields
