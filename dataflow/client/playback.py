"""Asks a running graph that is not live to pause, go on, make some steps, or change its speed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgpack

from dataflow.client.attach import NotRunning, network_of, reached
from dataflow.transport import Bus
from dataflow.transport.keys import runtime_key
from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 5.0


class Steering:
    """Steers one run. Thread-safe."""

    def __init__(self, found: RunningGraph, bus: Bus) -> None:
        self._found, self._bus = found, bus
        self._one_at_a_time = threading.Lock()

    def ask(
        self, action: str | None, steps: int = 1, speed: float | None = None, *, timeout: float = ANSWER_WITHIN
    ) -> dict[str, Any]:
        """Asks a run to do something, or (None) how it stands.

        `paused`, `ended`, `speed` (None: as fast as it goes), `stamp`, the last one given, and `replay`, where a
        recording stands in for its sources: the `span` of stamps that is played, and the `first`, which `--start`
        counts from. All processes with sources answer as one. Raises `NotRunning` where no process answers,
        or the run is live.
        """
        request = {} if action is None else {"action": action, "steps": steps, "speed": speed}
        key = runtime_key(self._found.namespace, "playback")
        with self._one_at_a_time:
            answers = self._bus.ask(key, msgpack.packb(request), timeout=timeout)
        name = self._found.name
        if not answers:
            raise NotRunning(
                f"graph {name!r} did not answer within {timeout:g} s: its processes are busy, or it has no sources"
            )
        told: list[dict[str, Any]] = [msgpack.unpackb(answer, raw=False) for answer in answers]
        for one in told:
            if not one["ok"]:
                raise NotRunning(f"graph {name!r} cannot do that: {one['error']}")
        stamps = [one["stamp"] for one in told if one["stamp"] is not None]
        return {
            "paused": any(one["paused"] for one in told),
            "ended": all(one["ended"] for one in told),
            "speed": told[0]["speed"],
            "stamp": max(stamps, default=None),
            "replay": next((one["replay"] for one in told if one["replay"] is not None), None),
        }


@contextmanager
def steering(found: RunningGraph) -> Iterator[Steering]:
    """Opens what steers a run."""
    with Bus(network_of(found)) as bus:
        reached(bus, found)
        yield Steering(found, bus)


def ask(
    found: RunningGraph,
    action: str | None,
    steps: int = 1,
    speed: float | None = None,
    *,
    timeout: float = ANSWER_WITHIN,
) -> dict[str, Any]:
    """As `Steering.ask`, once."""
    with steering(found) as steered:
        return steered.ask(action, steps, speed, timeout=timeout)
