"""Deterministic record and replay for robot perception, from Python.

    import dataflow

    recording = dataflow.open("run.mcap")
    recording["imu"].frame()                          # pandas
    recording["imu"].column("angular_velocity")       # numpy
    recording["image"][0]                             # a message; a notebook shows its picture

    graph = dataflow.Graph().add("camera", MyCamera).add("cloud", MyClouds).connect("cloud", depth="camera/depth")
    graph.run(record="run.mcap")
    dataflow.verify("run.mcap").identical

Importing this package imports nothing else: each name below is loaded when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataflow.api.builder import Graph
    from dataflow.api.join import Joined
    from dataflow.api.recordings import RecordedStreams, open
    from dataflow.api.runs import RunResult, Verified, launch, replay, run, verify
    from dataflow.api.session import Session
    from dataflow.api.stream import RecordedStream
    from dataflow.testing import Played, play

_HOMES = {
    "Graph": "dataflow.api.builder",
    "Joined": "dataflow.api.join",
    "Played": "dataflow.testing",
    "RecordedStream": "dataflow.api.stream",
    "RecordedStreams": "dataflow.api.recordings",
    "RunResult": "dataflow.api.runs",
    "Session": "dataflow.api.session",
    "Verified": "dataflow.api.runs",
    "launch": "dataflow.api.runs",
    "open": "dataflow.api.recordings",
    "play": "dataflow.testing",
    "replay": "dataflow.api.runs",
    "run": "dataflow.api.runs",
    "verify": "dataflow.api.runs",
}
"""The module of each public name."""

__all__ = [
    "Graph",
    "Joined",
    "Played",
    "RecordedStream",
    "RecordedStreams",
    "RunResult",
    "Session",
    "Verified",
    "launch",
    "open",
    "play",
    "replay",
    "run",
    "verify",
]


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'dataflow' has no attribute {name!r}; it has {', '.join(__all__)}")
    found = globals()[name] = getattr(importlib.import_module(home), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
