"""Holds what a process sends to others of its machine: one envelope to every link whose consumer takes its key."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from dataflow.transport.codec import encode_head
from dataflow.transport.envelope import Buffer, Envelope
from dataflow.transport.links import Outgoing
from dataflow.transport.pool import SharedPool
from dataflow.transport.shared import THRESHOLD

POOL_BYTES = 256 << 20
MAPPED_WITHIN = 1.0
SELDOM = 0.001
"""Seconds between messages for which consumers sleep that are worth a change of process each."""
_MAIN = threading.main_thread().ident


class Fanout:
    """The outgoing links of a process with the keys of their channels, and the pool that large messages lie in.

    `pool_bytes`: its size; 0: messages travel whole. `gives_way`: a consumer that was woken begins before this process
    goes on, unless messages come so fast that it is better for both to do several at a time.
    """

    def __init__(
        self,
        outgoing: Sequence[tuple[Sequence[str], Outgoing]],
        *,
        pool_bytes: int = POOL_BYTES,
        gives_way: bool = False,
    ) -> None:
        self._links = [link for _, link in outgoing]
        self._keys = [keys for keys, _ in outgoing]
        takers: dict[str, list[tuple[Outgoing, int]]] = {}
        for keys, link in outgoing:
            for number, key in enumerate(keys):
                takers.setdefault(key, []).append((link, number))
        self.takers: Mapping[str, Sequence[tuple[Outgoing, int]]] = takers
        """By key, the links whose consumers take it, and the number of its channel there."""
        self._sent = [0, 0]
        self._shared = [0, 0]
        self._full = 0
        self._gives_way, self._woke_at = gives_way, 0.0
        self._pool_bytes = pool_bytes
        self._pool: SharedPool | None = None

    def send(
        self, key: str, parts: Sequence[Buffer], envelope: Envelope | None = None, *, droppable: bool = True
    ) -> int:
        """Sends to all that take a key; returns how many those are.

        `parts` are consecutive buffers, and those of `envelope`, where that is given: it may go through the pool.
        `droppable`: a consumer of a live run that takes nothing for too long may miss it.
        """
        takers = self.takers.get(key)
        if not takers:
            return 0
        size = len(parts[0]) if len(parts) == 1 else sum(map(len, parts))
        if size >= THRESHOLD and envelope is not None and self._pool_bytes:
            self._lend(takers, parts, size, envelope, droppable=droppable)
        else:
            for link, channel in takers:
                link.send(channel, parts, size, droppable=droppable)
        if self._gives_way:
            self._give_way(takers)
        self._sent[0] += 1
        self._sent[1] += size
        return len(takers)

    def _give_way(self, takers: Sequence[tuple[Outgoing, int]]) -> None:
        """Lets consumers begin that were woken: they may have been put on this core. Only the main thread does: that
        which reads a source has the turn of its process, for which answers would wait."""
        woke = False
        for link, _ in takers:
            if link.ring.woke:
                link.ring.woke, woke = False, True
        if not woke:
            return
        now = time.monotonic()
        seldom, self._woke_at = now - self._woke_at >= SELDOM, now
        if seldom and threading.get_ident() == _MAIN:
            os.sched_yield()

    def _lend(
        self,
        takers: Sequence[tuple[Outgoing, int]],
        parts: Sequence[Buffer],
        size: int,
        envelope: Envelope,
        *,
        droppable: bool,
    ) -> None:
        pool = self._pool = self._pool or SharedPool(self._pool_bytes)
        able = []
        for link, channel in takers:
            if not link.present():
                continue
            if droppable and not link.may_borrow(size, pool.free):
                link.dropped += 1
            else:
                able.append((link, channel))
        if not able:
            return
        block = pool.write(parts, size, tuple([link.claim for link, _ in able]))
        if block is None:
            self._full += 1
            for link, channel in able:
                link.send(channel, parts, size, droppable=droppable)
            return
        self._shared[0] += 1
        self._shared[1] += size
        reference = pool.reference(encode_head(envelope), block, size)
        for link, channel in able:
            link.send(channel, [reference], len(reference), droppable=droppable, block=block)

    def room(self, nbytes: int) -> npt.NDArray[np.uint8] | None:
        """Returns memory in the pool for an array of a message (`SharedPool.room`), once a first large message was sent
        that others take; None where there is none. On any thread."""
        pool = self._pool
        return None if pool is None else pool.room(nbytes)

    def quiet(self) -> bool:
        """Returns whether no link has anything that waits for room, or a consumer that was replaced or has died."""
        for link in self._links:  # noqa: SIM110 - no generator: this is asked in every turn of a process's loop
            if not link.quiet():
                return False
        return True

    def flush(self) -> bool:
        """Sends what has waited for room, as far as there is some; True when nothing is left."""
        return not sum(not link.flush() for link in self._links if link.waiting)

    def joined(self) -> list[tuple[Sequence[str], Outgoing]]:
        """Returns the links, with their keys, whose consumer was replaced since the last look."""
        found = []
        for keys, link in zip(self._keys, self._links, strict=True):
            if link.present() and link.joined:
                link.joined = False
                found.append((keys, link))
        return found

    def take_leave(self, number: int, life: int) -> None:
        """The process at the other end of a link has died (`Outgoing.take_leave`)."""
        self._links[number].take_leave(life)

    def counters(self) -> dict[str, int]:
        """Counts envelopes and bytes that were sent, those of them that went through the pool, the large ones that
        travelled whole because it had no room, and those that did not reach a consumer that took nothing for too long.
        """
        return {
            "sent_messages": self._sent[0],
            "sent_bytes": self._sent[1],
            "shared_messages": self._shared[0],
            "shared_bytes": self._shared[1],
            "shared_full": self._full,
            "unsent": sum(link.dropped for link in self._links),
        }

    def close(self) -> None:
        """Gives the pool back, once consumers that were just sent their first reference have mapped it (bounded)."""
        if self._pool is None:
            return
        pool, self._pool = self._pool, None
        base, end = pool.base, time.monotonic() + MAPPED_WITHIN
        waiting = pool.consumers()
        while waiting and time.monotonic() < end:
            waiting = {c for c in waiting if not c.mapped(base)}
            if waiting:
                time.sleep(0.002)
        pool.close()
