"""Decompressed chunks that stay in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

KEPT_BYTES = 2**24
"""Enough to read a file from its beginning to its end, once or several times."""
MOST_BYTES = 2**28
"""Enough to go to and fro between the chunks of many streams."""
NOTED = 256
"""Chunks that are known to have been let go lately: those of so many streams, where each has separate ones."""

Key = tuple[Hashable, int]
"""File and number of a chunk."""


class ChunkCache:
    """The chunks of one or several files that were used last.

    It holds `KEPT_BYTES` at first, however much is read: to hold all that was read would take memory by the length of a
    recording. A chunk that is asked for again soon after it was let go shows that more are in use at a time, and makes
    room for itself besides, up to `MOST_BYTES`.
    """

    def __init__(self) -> None:
        self._room = KEPT_BYTES
        self._kept: OrderedDict[Key, bytes] = OrderedDict()
        self._gone: OrderedDict[Key, None] = OrderedDict()
        """Those that were let go lately, the oldest first."""
        self.nbytes = 0

    def get(self, key: Key) -> bytes | None:
        """Returns a chunk that is here."""
        data = self._kept.get(key)
        if data is not None:
            self._kept.move_to_end(key)
        return data

    def make_room(self, key: Key, size: int) -> None:
        """Lets the oldest go before a chunk of `size` bytes is read."""
        if key in self._gone:
            del self._gone[key]
            self._room = min(self._room + size, MOST_BYTES)
        while self._kept and self.nbytes + size > self._room:
            old, data = self._kept.popitem(last=False)
            self.nbytes -= len(data)
            self._gone[old] = None
        while len(self._gone) > NOTED:
            self._gone.popitem(last=False)

    def add(self, key: Key, data: bytes) -> None:
        """Keeps a chunk."""
        self._kept[key] = data
        self.nbytes += len(data)

    def clear(self) -> None:
        """Lets all go."""
        self._kept.clear()
        self._gone.clear()
        self.nbytes = 0
