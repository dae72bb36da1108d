"""What each process of a run is told to be: its kind and its configuration, as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.supervision.plan import ProcessPlan, RunPlan

Config = tuple[str, dict[str, Any]]
"""Kind of process ("operators" or "sink"), and the fields of its `ProcessConfig` or `SinkConfig`."""


def configurations(
    plan: RunPlan, processes: Mapping[str, ProcessPlan], endpoints: Mapping[str, str], secret: str
) -> dict[str, Config]:
    """Returns every process's configuration by label.

    `endpoints` are those on which the processes listen, `secret` what the run's messages are sealed with.
    """
    first = next(iter(processes))
    configs: dict[str, Config] = {}
    for label, process in processes.items():
        common = _common(plan, process, endpoints) | {"secret": secret}
        if process.sink is None:
            configs[label] = _operators(plan, process, common, endpoints, label == first)
        else:
            configs[label] = _sink(plan, process, common)
    return configs


def _common(plan: RunPlan, process: ProcessPlan, endpoints: Mapping[str, str]) -> dict[str, Any]:
    connect = [endpoints[up] for up in process.upstream]
    return {"label": process.label, "graph": plan.graph.to_json(), "connect": connect, "live": plan.live}


def _sink(plan: RunPlan, process: ProcessPlan, common: Mapping[str, Any]) -> Config:
    return "sink", {
        **common,
        "kind": process.sink,
        "streams": list(process.streams),
        "firings": list(plan.graph.nodes) if process.sink == "record" else [],
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
        "replay": _log(plan) if process.has_log else None,
        "window": list(plan.window),
        "rate": 1.0 if plan.live and plan.rate is None else plan.rate,
        "paranoid": plan.paranoid,
        "firings": plan.record is not None,
        "snapshots": plan.graph.record.snapshots,
        "warm": _warm_start(plan),
    }


def _log(plan: RunPlan) -> dict[str, Any]:
    log = plan.log
    assert log is not None
    return {
        "path": str(log.path),
        "streams": list(log.streams),
        "finals": dict(log.finals),
        "start": log.start,
        "end": log.end,
    }


def _warm_start(plan: RunPlan) -> dict[str, Any] | None:
    log = plan.log
    if log is None or log.start is None:
        return None
    return {"path": str(log.path), "stamp": log.start}
