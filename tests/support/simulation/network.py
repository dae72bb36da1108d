"""What is outside a simulated run: nobody. Its processes speak through rings, which are real; nobody subscribes.

The memory of rings is shared by the processes of the world as it is by real ones; only the eventfds that wake their
readers are the simulated machine's. Rings are small, so that a process that is frozen for long misses messages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dataflow.transport import Counters, NetworkConfig, make_ring

RING_BYTES = 1 << 13


def small_ring() -> int:
    """Makes a ring for a few dozen messages."""
    return make_ring(RING_BYTES)


class Publisher:
    """A publisher to which nobody listens."""

    matched = False


class Session:
    """What a bus shows of its session."""

    def put(self, key: str, payload: bytes) -> None:
        """Nobody listens."""


class Bus:
    """The operations of `dataflow.transport.Bus` that a process uses."""

    def __init__(self, config: NetworkConfig) -> None:
        self.config = config
        self.counted = Counters()
        self.session = Session()

    def publisher(self, stream: str) -> Publisher:
        return Publisher()

    def declare_static(self, stream: str, envelope: bytes) -> None:
        """Nobody asks for it."""

    def serve(self, key: str, answer: Callable[[Any], object]) -> None:
        """Nobody asks here."""

    def counters(self) -> dict[str, int]:
        return self.counted.as_dict()

    def close(self) -> None:
        """There is nothing to close."""


class NoTaps:
    """Nobody watches."""

    active = False

    def __init__(self, *_: Any) -> None:
        pass

    def close(self) -> None:
        """There is nothing to close."""
