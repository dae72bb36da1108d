"""Asks the flight recorder of a running graph to save its history."""

from __future__ import annotations

import secrets

import msgpack

from dataflow.client.attach import NotRunning, graph_of, network_of, reached
from dataflow.transport import Bus
from dataflow.transport.keys import runtime_key
from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 5.0


def trigger(found: RunningGraph, text: str, *, timeout: float = ANSWER_WITHIN) -> None:
    """Asks it. Raises `NotRunning` where the graph has no flight recorder, or no process answers."""
    if graph_of(found).record.flight is None:
        raise NotRunning(f"graph {found.name!r} has no flight recorder: give it one with record: {{keep: 60s}}")
    request = msgpack.packb({"id": secrets.token_hex(8), "text": text})
    with Bus(network_of(found)) as bus:
        reached(bus, found)
        answers = bus.ask(runtime_key(found.namespace, "trigger", "**"), request, timeout=timeout)
    if not any(msgpack.unpackb(answer, raw=False)["ok"] for answer in answers):
        raise NotRunning(f"no process of graph {found.name!r} answered within {timeout:g} s")
