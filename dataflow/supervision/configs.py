"""Configurations of the processes of a run, as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.supervision.links import pairs_of
from dataflow.supervision.plan import LogPlan, ProcessPlan, RunPlan

BEYOND_A_LINK = 64
"""Windows of messages that the live sources of another machine may be ahead."""
Config = tuple[str, dict[str, Any]]
"""Kind of process ("operators" or "sink"), and the fields of its `ProcessConfig` or `SinkConfig`."""


def configurations(
    plan: RunPlan, processes: Mapping[str, ProcessPlan], endpoints: Mapping[str, str]
) -> dict[str, Config]:
    """Returns every process's configuration by label.

    `endpoints` are those on which the processes listen.
    """
    first = next((label for label, process in processes.items() if process.machine is None), "")
    configs: dict[str, Config] = {}
    graph, pairs = plan.graph.to_json(), pairs_of(plan.graph, processes)
    for label, process in processes.items():
        links_in = [list(keys) for (_, taker), keys in pairs.items() if taker == label]
        common = {"label": label, "graph": graph, "live": plan.live, "links_in": links_in}
        if process.sink is None:
            configs[label] = _operators(plan, process, common, endpoints, label == first)
            configs[label][1]["links_out"] = [
                (plan.live and taker in processes and processes[taker].sink is None, list(keys))  # a gate takes all
                for (maker, taker), keys in pairs.items()
                if maker == label
            ]
        else:
            configs[label] = _sink(plan, process, common)
    return configs


def _sink(plan: RunPlan, process: ProcessPlan, common: Mapping[str, Any]) -> Config:
    return "sink", {
        **common,
        "kind": process.sink,
        "streams": list(process.streams),
        "firings": list(process.firings),
        "options": dict(process.options),
    }


def _operators(
    plan: RunPlan, process: ProcessPlan, common: Mapping[str, Any], endpoints: Mapping[str, str], first: bool
) -> Config:
    return "operators", {
        **common,
        "nodes": list(process.nodes),
        "publish": dict(process.publish),
        "subscribe": list(process.subscribe),
        "listen": [endpoints[process.label], *(plan.graph.network.listen if first else ())],
        "replay": replay_of(plan.log) if process.has_log else None,
        "window": list(plan.window),
        "ahead": _ahead(plan) if plan.live and process.machine is not None else None,
        "rate": 1.0 if plan.live and plan.rate is None else plan.rate,
        "paused": plan.paused,
        "paranoid": plan.paranoid,
        "firings": plan.keeps_records,
        "warm": warm_start_of(plan.log),
    }


def _ahead(plan: RunPlan) -> list[int]:
    """Returns the messages and bytes that live sources of another machine may be ahead of the graph, of which they hear
    by a link that may be slow or away for a while: as much as waits for a link."""
    from dataflow.machines.pipe import MOST_WAITING  # most runs need no network

    return [plan.window[0] * BEYOND_A_LINK, max(plan.window[1], MOST_WAITING)]


def replay_of(log: LogPlan | None) -> dict[str, Any] | None:
    """Returns the `replay` of the process that reads a recording."""
    if log is None:
        return None
    return {
        "path": str(log.path),
        "streams": list(log.streams),
        "finals": dict(log.finals),
        "first": log.first,
        "start": log.start,
        "end": log.end,
        "bag": log.bag,
    }


def warm_start_of(log: LogPlan | None) -> dict[str, Any] | None:
    """Returns the `warm` of the processes of a replay that begins in the middle of a recording."""
    if log is None or log.start is None or log.bag is not None:
        return None
    return {"path": str(log.path), "stamp": log.start}
