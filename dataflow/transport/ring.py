"""A ring in shared memory from one process to another, with an eventfd that wakes the reader.

One writer, one reader, each on one thread. The parent of both makes the memory (a memfd) and hands it down, so nothing
else on the machine can write to it: what comes out of a ring comes from the process at its other end. Five words are
shared, each with one writer: `head` and `tail` count the bytes ever written and read, `asleep` is set by a reader that
is about to wait, `blocked` by a writer that found no room,
`readers` names the reader that came last, by number. A frame counts once `head` includes it, which is written
last; so a writer that is killed leaves whole frames, and its successor goes on with the same ring. A reader that takes
the place of another skips what was meant for that one.

The writer goes back to the beginning of a ring that is empty once it has come `_AGAIN` bytes far, so one whose reader
keeps up touches few pages, which stay in the cache; the others cost no memory.

Neither side waits here: `put` returns False when there is no room, `take` returns what is there.

On x86-64 other cores see stores in the order in which they were made. Elsewhere fences see to it that a frame's content
is seen before the `head` that includes it.
"""

from __future__ import annotations

import mmap
import os
import platform
import struct
import threading
from collections.abc import Sequence

CAPACITY = 1 << 20
_HEADER = 4096
_HEAD, _TAIL, _ASLEEP, _BLOCKED, READERS = (64 * k // 8 for k in range(5))  # a cache line each
_FRAME = struct.Struct("<II")
_ROUNDED = _FRAME.size + 7
"""A frame takes its content and this of the ring, without the last three bits: whole words, so that a head
never wraps."""
_SKIP = 0xFFFFFFFF
_AGAIN = 1 << 16
_REORDERS = platform.machine() not in ("x86_64", "AMD64")

Bytes = bytes | bytearray | memoryview


class RingError(ValueError):
    """A frame that no ring of this size can carry, or a ring whose content contradicts itself."""


def make_ring(capacity: int = CAPACITY) -> int:
    """Makes an empty ring; returns its descriptor, which writer and reader inherit. `capacity` is a power of two."""
    if capacity < 64 or capacity & (capacity - 1):
        raise RingError(f"a ring's capacity is a power of two of at least 64 bytes, not {capacity}")
    descriptor = os.memfd_create("ring")
    os.ftruncate(descriptor, _HEADER + capacity)
    return descriptor


class _End:
    """Holds what both ends share: the mapped memory and its words."""

    def __init__(self, descriptor: int) -> None:
        size = os.fstat(descriptor).st_size
        self.capacity = size - _HEADER
        self._memory = mmap.mmap(descriptor, size)
        self.words = self._words = memoryview(self._memory)[:_HEADER].cast("Q")
        self._lock = threading.Lock()

    def _fence(self) -> None:
        """Orders the stores before it with the loads after it: an atomic operation, which a lock is made of."""
        with self._lock:
            pass

    def close(self) -> None:
        self._words.release()
        self._memory.close()


class RingWriter(_End):
    """The writing end. `wake` is the reader's eventfd."""

    def __init__(self, descriptor: int, wake: int) -> None:
        super().__init__(descriptor)
        self._wake = wake
        self.woke = False
        """A reader that slept was woken; reset when that is noted."""
        self._head = self._words[_HEAD]
        self.largest = self.capacity // 4 - _FRAME.size
        """Bytes of the largest frame that can pass, once there is room."""

    def reader(self) -> int:
        """Returns which reader came last to the other end, by number; 0: there was none yet."""
        return int(self._words[READERS])

    @property
    def written(self) -> int:
        """Returns how many bytes have ever been written."""
        return self._head

    def taken(self) -> int:
        """Returns how many bytes the reader has ever taken."""
        return int(self._words[_TAIL])

    def put(self, channel: int, parts: Sequence[Bytes]) -> bool:
        """Writes one frame, on a numbered channel of this ring; False, and nothing, when there is no room for it now.
        The reader then wakes the writer once it has taken something. Raises `RingError` for a frame that never fits."""
        size = len(parts[0]) if len(parts) == 1 else sum(map(len, parts))
        if size > self.largest:
            raise RingError(f"a frame of {size} bytes does not fit a ring of {self.capacity} bytes")
        needed, head, words, memory = (size + _ROUNDED) & ~7, self._head, self._words, self._memory
        at = head & (self.capacity - 1)
        tail = words[_TAIL]
        again = head == tail and at >= _AGAIN and at >= needed  # what is skipped and the frame fit together
        skipped = self.capacity - at if again or at + needed > self.capacity else 0
        if head - tail + skipped + needed > self.capacity and not self._has_room(skipped + needed):
            return False
        if skipped:
            _FRAME.pack_into(memory, _HEADER + at, _SKIP, 0)
            at = 0
        start = _HEADER + at
        _FRAME.pack_into(memory, start, size, channel)
        start += _FRAME.size
        for part in parts:
            end = start + len(part)
            memory[start:end] = part
            start = end
        if _REORDERS:
            self._fence()
            self._fence()
        self._head = words[_HEAD] = head + skipped + needed
        with self._lock:  # a fence: see `_fence`
            pass
        if words[_ASLEEP]:
            words[_ASLEEP] = 0
            os.eventfd_write(self._wake, 1)
            self.woke = True
        return True

    def _has_room(self, needed: int) -> bool:
        """Has the reader wake this side, unless it has just taken enough."""
        self._words[_BLOCKED] = 1
        self._fence()
        return bool(self._head - self._words[_TAIL] + needed <= self.capacity)


class RingReader(_End):
    """The reading end. `wake` is the writer's eventfd, for when it waits for room. Skips what is there already.
    `number`: one more than that of the reader before; the first is 1."""

    def __init__(self, descriptor: int, wake: int, number: int) -> None:
        super().__init__(descriptor)
        self._wake = wake
        self._tail = self._words[_HEAD]
        self._words[_TAIL] = self._tail
        self._words[READERS] = number
        self._words[_BLOCKED] = 0

    def arrived(self) -> bool:
        """Returns whether there is something to take."""
        return bool(self._words[_HEAD] != self._tail)

    def take(self, limit: int) -> list[tuple[int, bytes]]:
        """Up to `limit` frames that are there, in order: (channel, content). Raises `RingError` for a broken ring."""
        head, tail = self._words[_HEAD], self._tail
        if _REORDERS:
            self._fence()
        taken: list[tuple[int, bytes]] = []
        while tail != head and len(taken) < limit:
            at = tail & (self.capacity - 1)
            size, channel = _FRAME.unpack_from(self._memory, _HEADER + at)
            if size == _SKIP:
                tail += self.capacity - at
                continue
            room = (size + _ROUNDED) & ~7
            if at + room > self.capacity or tail + room > head:
                raise RingError(f"a frame of {size} bytes lies beyond what was written to the ring")
            start = _HEADER + at + _FRAME.size
            taken.append((channel, self._memory[start : start + size]))
            tail += room
        if tail != self._tail:
            self._tail = self._words[_TAIL] = tail
            with self._lock:  # a fence
                pass
            if self._words[_BLOCKED]:
                self._words[_BLOCKED] = 0
                os.eventfd_write(self._wake, 1)
        return taken

    def sleep(self) -> bool:
        """Announces that the reader is about to wait for its eventfd; False when there is something to take instead."""
        self._words[_ASLEEP] = 1
        self._fence()
        if self._words[_HEAD] == self._tail:
            return True
        self._words[_ASLEEP] = 0
        return False

    def awake(self) -> None:
        """Ends the wait."""
        self._words[_ASLEEP] = 0
