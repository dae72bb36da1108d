"""Seals: what shows that a publication comes from a process of this very run.

A run has a secret, which its processes get with their configuration and nobody else does. Each publication carries,
as its Zenoh attachment, a keyed BLAKE2b of the stream's name and of the payload's beginning, where the number, the
stamp and the kind stand. Who can only read the bus can copy a seal, but cannot make one for another number.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from typing import Final

SEAL_BYTES: Final = 16
SEALED: Final = 512
"""Bytes of a payload, from its beginning, that its seal covers: head and, of small messages, everything."""


def new_secret() -> str:
    """Makes the secret of a run: 64 hexadecimal digits."""
    return secrets.token_hex(32)


class Seal:
    """Makes and checks the seals of one stream. Thread-safe."""

    __slots__ = ("_keyed",)

    def __init__(self, secret: str, stream: str) -> None:
        key = hashlib.blake2b(stream.encode(), key=bytes.fromhex(secret), digest_size=32).digest()
        self._keyed = hashlib.blake2b(key=key, digest_size=SEAL_BYTES)

    def of(self, payload: bytes) -> bytes:
        """Returns the seal of `payload`."""
        keyed = self._keyed.copy()
        keyed.update(payload[:SEALED])
        return keyed.digest()

    def fits(self, payload: bytes, seal: bytes) -> bool:
        """Returns whether `seal` is that of `payload`; takes equally long for every wrong one."""
        return hmac.compare_digest(self.of(payload), seal)
