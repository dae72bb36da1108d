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

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from dataflow.api.builder import Graph
    from dataflow.api.join import Joined
    from dataflow.api.recordings import RecordedStreams, open
    from dataflow.api.runs import RunResult, Verified, launch, replay, run, verify
    from dataflow.api.session import Session
    from dataflow.api.stream import RecordedStream
    from dataflow.testing import Played, play
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "api.builder": ("Graph",),
            "api.join": ("Joined",),
            "api.recordings": ("RecordedStreams", "open"),
            "api.runs": ("RunResult", "Verified", "launch", "replay", "run", "verify"),
            "api.session": ("Session",),
            "api.stream": ("RecordedStream",),
            "testing": ("Played", "play"),
        },
    )

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
