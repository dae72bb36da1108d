"""Asks a running replay to pause, go on, or make some steps."""

from __future__ import annotations

from typing import Any

import msgpack

from dataflow.client.attach import NotRunning, reached
from dataflow.transport import Bus, NetworkConfig
from dataflow.transport.keys import runtime_key
from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 5.0


def ask(found: RunningGraph, action: str | None, steps: int = 1, *, timeout: float = ANSWER_WITHIN) -> dict[str, Any]:
    """Asks the replay to do something, or (None) how it stands: `paused`, `ended` and `stamp`, the last one given.

    Raises `NotRunning` where nobody answers: the graph plays no recording, or the process is busy for too long.
    """
    request = {} if action is None else {"action": action, "steps": steps}
    with Bus(NetworkConfig(connect=found.endpoints)) as bus:
        reached(bus, found)
        answers = bus.ask(runtime_key(found.namespace, "playback"), msgpack.packb(request), timeout=timeout)
    if not answers:
        raise NotRunning(
            f"graph {found.name!r} did not answer within {timeout:g} s: it plays no recording (dataflow replay), or "
            "its process is busy"
        )
    answer: dict[str, Any] = msgpack.unpackb(answers[0], raw=False)
    if not answer["ok"]:
        raise NotRunning(answer["error"])
    return answer
