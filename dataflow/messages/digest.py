"""The digest of a whole stream: two streams are the same when their digests are equal."""

from __future__ import annotations

import xxhash


class StreamDigest:
    """Accumulates message digests, in stream order, into xxh3-128."""

    __slots__ = ("_hash", "count")

    def __init__(self) -> None:
        self._hash = xxhash.xxh3_128()
        self.count = 0

    def update(self, message_digest: bytes) -> None:
        self._hash.update(message_digest)
        self.count += 1

    def hexdigest(self) -> str:
        return self._hash.hexdigest()
