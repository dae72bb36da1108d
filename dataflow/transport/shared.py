"""Shared memory between processes of one machine: a large envelope is written once, every consumer reads it in place.

The memory is anonymous (memfd), so nothing is left behind however a process ends. A producer owns a pool of blocks;
what travels on the link is a reference to one. A consumer maps the pool read-only, and notes on the link's *board*,
memory that only it writes to, which block it no longer uses: every byte has one writer, and a block is used again only
when all its consumers have released it (or their processes have ended).
"""

from __future__ import annotations

import fcntl
import mmap
import os
import weakref
from functools import partial
from typing import Any, Final

import msgpack
import numpy as np
import numpy.typing as npt

from dataflow.transport.envelope import MAGIC, PRELUDE, DecodeError, Kind

THRESHOLD: Final = 32 << 10
"""Envelopes of fewer bytes travel whole: below it a reference is not faster (benchmarks/transport.md)."""

SLOTS: Final = 4096
BOARD_BYTES: Final = 8 * (SLOTS + 1)
_SEAL_FUTURE_WRITE: Final = 0x0010  # Linux 5.1; not in Python 3.11's fcntl
POOL_NAME: Final = "dataflow-pool-"
_REFERENCE: Final = bytes([Kind.REFERENCE])


class SharedMemoryError(RuntimeError):
    """A pool or board cannot be made or opened; the message names it and the reason."""


def make_memory(name: str, size: int) -> int:
    """Makes anonymous memory that cannot be resized; returns its descriptor. Raises `SharedMemoryError`."""
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


def protect(descriptor: int) -> None:
    """Leaves writing to the mappings that exist."""
    try:
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEAL_FUTURE_WRITE)
    except OSError:  # an older kernel: the others map read-only by agreement
        return


def open_memory(pid: int, descriptor: int, name: str) -> mmap.mmap:
    """Maps another process's shared memory read-only; raises `SharedMemoryError` unless it is the one named."""
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


def make_board() -> int:
    """Makes the memory in which a consumer marks the blocks of its producer's pool that it has released."""
    descriptor = os.memfd_create("board")
    os.ftruncate(descriptor, BOARD_BYTES)
    return descriptor


class _Lent(weakref.ref["npt.NDArray[np.uint8]"]):
    """Refers to a block in use. (`weakref.finalize` costs as much as decoding the message.)"""

    __slots__ = ("of",)
    of: tuple[int, int, int]
    """Base of the pool, slot, generation."""


class Board:
    """Holds what the consumer at the end of a link has released. Written here only, read by the producer."""

    def __init__(self, descriptor: int) -> None:
        """Maps the memory that was handed down."""
        self._cells = memoryview(mmap.mmap(descriptor, BOARD_BYTES)).cast("Q")
        self._base = 0
        self._pool: mmap.mmap | None = None
        self._lent: dict[int, _Lent] = {}

    def pool(self, base: int) -> mmap.mmap | None:
        """Returns the pool whose generations begin at `base`, if that is the one in use."""
        return self._pool if base == self._base else None

    def use(self, pool: mmap.mmap, base: int) -> None:
        """Notes that the pool whose generations begin at `base` is mapped, and keeps it so; an earlier one is over."""
        self._pool = pool
        self._base = self._cells[SLOTS] = base

    def lend(self, block: npt.NDArray[np.uint8], base: int, slot: int, generation: int) -> None:
        """Has a block released when the last view of it is gone."""
        lent = _Lent(block, self._take_back)
        lent.of = base, slot, generation
        self._lent[id(lent)] = lent  # a reference that is gone has no callback

    def _take_back(self, lent: _Lent) -> None:
        del self._lent[id(lent)]
        self.release(*lent.of)

    def release(self, base: int, slot: int, generation: int) -> None:
        if base == self._base:
            self._cells[slot] = generation


class PoolReader:
    """The pools of other processes, mapped on first use. A mapping lasts as long as a link's board or a view of a
    message refers to it: one whose producer was replaced goes with the last message from it."""

    def __init__(self) -> None:
        self._pools: weakref.WeakValueDictionary[str, mmap.mmap] = weakref.WeakValueDictionary()

    def resolve(self, payload: bytes, board: Board) -> memoryview:
        """Returns the envelope that a reference stands for, in place and read-only.

        The block is released when the last view of it is gone. Raises `SharedMemoryError` when the pool cannot be
        mapped and `DecodeError` for what is no reference.
        """
        _, _, _, head_bytes, body_bytes = PRELUDE.unpack_from(payload)
        fields = _reference(memoryview(payload)[PRELUDE.size + head_bytes :], body_bytes)
        pool_id, base, pid, descriptor, offset, size, slot, generation = fields
        used = board.pool(base)
        pool = self._map(pool_id, pid, descriptor) if used is None else used
        if offset + size > len(pool) or slot >= SLOTS or size < PRELUDE.size:
            raise DecodeError(f"reference to {size} bytes at {offset} of a pool of {len(pool)}")
        if used is None:
            board.use(pool, base)
        block: npt.NDArray[np.uint8] = np.ndarray((size,), np.uint8, pool, offset)
        board.lend(block, base, slot, generation)
        return block.data

    def _map(self, pool_id: str, pid: int, descriptor: int) -> mmap.mmap:
        found = self._pools.get(pool_id)
        if found is None:
            found = self._pools[pool_id] = open_memory(pid, descriptor, POOL_NAME + pool_id)
        return found


def is_reference(payload: bytes) -> bool:
    """Returns whether the payload is an envelope that stands for one in shared memory."""
    return payload[5:6] == _REFERENCE and payload[:4] == MAGIC and len(payload) >= PRELUDE.size


_FIELDS: Final = (str, *(int,) * 7)
_unpack: Final = partial(msgpack.unpackb, raw=False, use_list=False, max_array_len=8, max_str_len=16, max_map_len=0)


def _reference(body: memoryview, body_bytes: int) -> tuple[Any, ...]:
    try:
        fields = _unpack(body)
    except Exception as error:  # msgpack raises a dozen types for malformed input
        raise DecodeError(f"reference: {error}") from None
    if (
        len(body) != body_bytes
        or fields.__class__ is not tuple
        or tuple(map(type, fields)) != _FIELDS
        or min(fields[1:]) < 0
    ):
        raise DecodeError("reference: expected [pool id, base, process, descriptor, offset, size, slot, generation]")
    return fields
