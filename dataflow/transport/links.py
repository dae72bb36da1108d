"""The links between two processes of one machine: a ring for what is said, a board for what shared memory is used.

A large message lies in the pool and passes as a reference; where the pool has no room, it passes whole: what does not
fit a quarter of the ring in pieces, in its place in the order. What the ring has no room for waits here, in order.
A run that loses nothing bounds that by its windows, and so does any run for a recorder. For other consumers of a live
run it is bounded here: beyond `most`, the oldest messages are dropped, and the consumer sees a gap in their numbers;
what is said once (ends of streams, static messages) is kept.
"""

from __future__ import annotations

import mmap
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from dataflow.transport.envelope import Buffer, DecodeError
from dataflow.transport.pool import Block
from dataflow.transport.ring import READERS, RingReader, RingWriter
from dataflow.transport.shared import BOARD_BYTES, SLOTS, Board, PoolReader, SharedMemoryError, is_reference

_FIRST, _LAST = 1 << 31, 1 << 30
_WHOLE = _FIRST | _LAST
_CHANNEL = _LAST - 1
_AT_ONCE = 1024
STILL = 0.3


class LinkClaim:
    """One consumer process behind a link, as the pool sees it."""

    def __init__(self, cells: memoryview) -> None:
        self._cells = cells
        self._dropped: dict[int, int] = {}
        self.gone = False

    def released(self, slot: int, generation: int) -> bool:
        return self.gone or self._cells[slot] == generation or self._dropped.get(slot) == generation

    def mapped(self, base: int) -> bool:
        return self.gone or self._cells[SLOTS] == base

    def drop(self, block: Block) -> None:
        """Notes that a block's reference is not sent to this consumer after all."""
        self._dropped[block.slot] = block.generation


@dataclass(slots=True)
class _Waiting:
    """A message that waits for room: its frames, how many of them have gone, and what dropping it means."""

    frames: list[tuple[int, Sequence[Buffer]]]
    size: int
    droppable: bool
    block: Block | None
    gone: int = 0


class Outgoing:
    """The producer's end of a link. `most`: (messages, bytes) that may wait; None: as many as there are."""

    def __init__(self, ring: int, wake: int, board: int, most: tuple[int, int] | None) -> None:
        self._ring = self.ring = RingWriter(ring, wake)
        self._words = self._ring.words
        self._cells = memoryview(mmap.mmap(board, BOARD_BYTES)).cast("Q")
        self._most = most
        self._reader = self._ring.reader()
        self._waiting: deque[_Waiting] = deque()
        self._bytes = 0
        self._lent: deque[tuple[int, int, int]] = deque()  # slot, generation and bytes of blocks that it may hold
        self._taken, self._took_at = self._ring.taken(), time.monotonic()
        self.claim = LinkClaim(self._cells)
        self.away = False
        """The consumer has died: what is sent now has no receiver."""
        self.joined = False
        """Another process has taken the consumer's place, which is not noticed yet: it lacks what is sent once."""
        self.dropped = 0
        """Envelopes that did not reach the consumer: it took nothing for too long."""

    @property
    def waiting(self) -> bool:
        return bool(self._waiting)

    def take_leave(self, life: int) -> None:
        """The consumer that was the process `life` in its place has died: what was meant for it is not sent any more.
        This may arrive late, when another process is there already."""
        self._new_reader()
        if self._reader <= life:
            self.away = True
            self._begin_anew()

    def quiet(self) -> bool:
        """Returns whether nothing waits for room, and the consumer is the one that it was at the last look."""
        return not (self._waiting or self.joined or self.away) and self._reader == self._words[READERS]

    def present(self) -> bool:
        """Returns whether the consumer is present, or is believed to be."""
        if self._reader != self._words[READERS]:
            self._new_reader()
        return not self.away

    def may_borrow(self, size: int, free: Callable[[], int]) -> bool:
        """Returns whether the consumer may be lent another block.

        Where messages may be dropped, one that has taken nothing for `STILL` seconds may hold as much of the pool as is
        free, so that one that is stopped leaves room for the others.
        """
        if self._most is None or self._takes():
            return True
        while self._lent and self.claim.released(*self._lent[0][:2]):
            self._lent.popleft()
        if len(self._lent) * size <= free():
            return True
        self._lent = deque(lent for lent in self._lent if not self.claim.released(*lent[:2]))
        return sum(held for _, _, held in self._lent) + size <= free()

    def _takes(self) -> bool:
        """Returns whether the consumer has taken something of late, or all that there is."""
        taken, now = self._ring.taken(), time.monotonic()
        if taken != self._taken or taken == self._ring.written:
            self._taken, self._took_at = taken, now
        return now - self._took_at < STILL

    def send(
        self, channel: int, parts: Sequence[Buffer], size: int, *, droppable: bool = True, block: Block | None = None
    ) -> None:
        """Sends one envelope, given as consecutive buffers, or keeps it until there is room."""
        if (self.away or self._reader != self._words[READERS]) and not self.present():
            if block is not None:
                self.claim.drop(block)
            return
        if block is not None and self._most is not None:
            self._lent.append((block.slot, block.generation, block.capacity))
        if not self._waiting and size <= self._ring.largest:
            if self._ring.put(channel | _WHOLE, parts):
                return
            frames = [(channel | _WHOLE, parts)]
        else:
            frames = list(self._frames(channel, parts, size))
        self._waiting.append(_Waiting(frames, size, droppable, block))
        self._bytes += size
        self.flush()
        self._drop_oldest()

    def flush(self) -> bool:
        """Sends what there is room for; True when nothing is left."""
        if self._waiting:
            self._new_reader()
        while self._waiting:
            first = self._waiting[0]
            while first.gone < len(first.frames):
                if not self._ring.put(*first.frames[first.gone]):
                    return False
                first.gone += 1
            self._waiting.popleft()
            self._bytes -= first.size
        return True

    def _frames(self, channel: int, parts: Sequence[Buffer], size: int) -> Iterator[tuple[int, Sequence[Buffer]]]:
        if size <= self._ring.largest:
            yield channel | _WHOLE, parts
            return
        whole = memoryview(b"".join(parts))
        most = self._ring.largest
        for start in range(0, size, most):
            flags = (_FIRST if start == 0 else 0) | (_LAST if start + most >= size else 0)
            yield channel | flags, [whole[start : start + most]]

    def _drop_oldest(self) -> None:
        if self._most is None:
            return
        at = 0
        while at < len(self._waiting) and (len(self._waiting) > self._most[0] or self._bytes > self._most[1]):
            entry = self._waiting[at]
            if not entry.droppable or entry.gone:
                at += 1
                continue
            del self._waiting[at]
            self._bytes -= entry.size
            self.dropped += 1
            if entry.block is not None:
                self.claim.drop(entry.block)

    def _new_reader(self) -> bool:
        """Returns whether another process has taken the consumer's place since the last look."""
        reader = self._ring.reader()
        if reader == self._reader:
            return False
        self._reader = reader
        self.away = False
        self.joined = True
        self._begin_anew()
        return True

    def _begin_anew(self) -> None:
        self._waiting.clear()
        self._lent.clear()
        self._bytes = 0
        self.claim.gone = True
        self.claim = LinkClaim(self._cells)


class Incoming:
    """The consumer's end of a link, with the keys of its channels. `life`: which process in its place this is."""

    def __init__(self, ring: int, wake: int, board: int, keys: Sequence[str], pools: PoolReader, life: int) -> None:
        self._ring = RingReader(ring, wake, life)
        self.arrived, self.sleep, self.awake = self._ring.arrived, self._ring.sleep, self._ring.awake
        self._board = Board(board)
        self._keys, self._pools = keys, pools
        self._pieces: dict[int, list[bytes]] = {}
        self.messages = self.nbytes = self.unresolved = 0
        """The count taken so far, and how much of it lies in memory that could not be opened."""

    def take(self) -> list[tuple[str, Buffer]]:
        """Returns (key, payload) of what has arrived."""
        found: list[tuple[str, Buffer]] = []
        for flagged, content in self._ring.take(_AT_ONCE):
            channel = flagged & _CHANNEL
            if flagged < _WHOLE or self._pieces:
                whole = self._whole(flagged, content)
                if whole is None:
                    continue
                content = whole
            payload: Buffer = content
            if is_reference(content):
                payload = self._resolved(content)
            self.messages += 1
            self.nbytes += len(payload)
            found.append((self._keys[channel], payload))
        return found

    def _whole(self, flagged: int, content: bytes) -> bytes | None:
        """Puts pieces together; None while some are missing, and for those of which the first went to another."""
        if flagged & _FIRST and flagged & _LAST:
            self._pieces.pop(flagged & _CHANNEL, None)
            return content
        channel = flagged & _CHANNEL
        if flagged & _FIRST:
            self._pieces[channel] = [content]
        elif channel in self._pieces:
            self._pieces[channel].append(content)
        if flagged & _LAST and channel in self._pieces:
            return b"".join(self._pieces.pop(channel))
        return None

    def _resolved(self, reference: bytes) -> Buffer:
        try:
            return self._pools.resolve(reference, self._board)
        except (SharedMemoryError, DecodeError):
            self.unresolved += 1
            return reference
