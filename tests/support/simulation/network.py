"""What leaves a simulated machine: nothing. Nobody subscribes from outside, asks, or watches."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from dataflow.transport.counters import Counters


class Bus:
    """The operations of `dataflow.transport.Bus` that a process uses."""

    def __init__(self, config: Any) -> None:
        self.counted = Counters()
        self.session = SimpleNamespace(put=lambda key, payload: None)

    def publisher(self, stream: str) -> Any:
        return SimpleNamespace(matched=False)

    def declare_static(self, stream: str, envelope: bytes) -> None:
        """Nobody asks for it."""

    def serve(self, key: str, answer: Callable[[Any], object]) -> None:
        """Nobody asks."""

    def counters(self) -> dict[str, int]:
        return self.counted.as_dict()

    def close(self) -> None:
        """There is nothing to close."""


class Nobody:
    """In place of the taps and of the publisher to the outside."""

    active = False

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def close(self) -> None:
        """There is nothing to close."""
