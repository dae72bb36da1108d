"""What leaves a simulated machine: nothing. Nobody subscribes from outside or watches; parameters can be set."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import msgpack

from dataflow.transport.publisher import Counters
from simulation.world import Process, World

Answer = Callable[[Any], object]


class Query:
    """A request from outside; its answer is not looked at."""

    key_expr = ""

    def __init__(self, fields: dict[str, Any]) -> None:
        data = msgpack.packb(fields)
        self.payload = SimpleNamespace(to_bytes=lambda: data)

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *error: object) -> None:
        """It is answered."""

    def reply(self, key: str, payload: bytes) -> None:
        """Nobody waits for it."""


class Bus:
    """The operations of `dataflow.transport.Bus` that a process uses."""

    def __init__(self, world: World, served: dict[str, tuple[Process, Answer]]) -> None:
        """`served`: key → the process that answers there, and its answer."""
        self._world, self._served = world, served
        self.counted = Counters()
        self.session = SimpleNamespace(put=lambda key, payload: None)

    def publisher(self, stream: str) -> Any:
        return SimpleNamespace(matched=False)

    def declare_static(self, stream: str, envelope: bytes) -> None:
        """Nobody asks for it."""

    def serve(self, key: str, answer: Answer) -> None:
        task = self._world.task
        assert task is not None
        self._served[key] = task.process, answer

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
