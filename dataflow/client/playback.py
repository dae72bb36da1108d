"""Asks a running graph that is not live to pause, go on, make some steps, or change its speed."""

from __future__ import annotations

from typing import Any

import msgpack

from dataflow.client.attach import NotRunning, reached
from dataflow.transport import Bus, NetworkConfig
from dataflow.transport.keys import runtime_key
from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 5.0


def ask(
    found: RunningGraph,
    action: str | None,
    steps: int = 1,
    speed: float | None = None,
    *,
    timeout: float = ANSWER_WITHIN,
) -> dict[str, Any]:
    """Asks a run to do something, or (None) how it stands: `paused`, `ended`, `speed` (None: as fast as it goes),
    `stamp`, the last one given, and `replay`: whether a recording stands in for its sources.

    All processes with sources are asked and answer as one. Raises `NotRunning` where nobody answers, or the run is
    live.
    """
    request = {} if action is None else {"action": action, "steps": steps, "speed": speed}
    with Bus(NetworkConfig(connect=found.endpoints)) as bus:
        reached(bus, found)
        answers = bus.ask(runtime_key(found.namespace, "playback"), msgpack.packb(request), timeout=timeout)
    if not answers:
        raise NotRunning(
            f"graph {found.name!r} did not answer within {timeout:g} s: its processes are busy, or it has no sources"
        )
    told: list[dict[str, Any]] = [msgpack.unpackb(answer, raw=False) for answer in answers]
    for one in told:
        if not one["ok"]:
            raise NotRunning(f"graph {found.name!r} cannot do that: {one['error']}")
    stamps = [one["stamp"] for one in told if one["stamp"] is not None]
    return {
        "paused": any(one["paused"] for one in told),
        "ended": all(one["ended"] for one in told),
        "speed": told[0]["speed"],
        "stamp": max(stamps, default=None),
        "replay": any(one["replay"] for one in told),
    }
