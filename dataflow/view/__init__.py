"""Seeing a graph in Rerun: visualisers, blueprint, sinks.

A viewer is an ordinary subscriber: `ViewerSink` draws what it is handed and can neither slow nor end a producer.
"""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from dataflow.view.canvas import Canvas, visualizer
    from dataflow.view.drawing import visualize
    from dataflow.view.process import ViewerError
    from dataflow.view.recordings import as_alarm, from_recording
    from dataflow.view.scene import SceneState, ViewOptions
    from dataflow.view.sink import SinkStatistics, ViewerSink
    from dataflow.view.targets import Connect, Save, Serve, Spawn, Target, parse_target
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "canvas": ("Canvas", "visualizer"),
            "drawing": ("visualize",),
            "recordings": ("as_alarm", "from_recording"),
            "process": ("ViewerError",),
            "scene": ("SceneState", "ViewOptions"),
            "sink": ("SinkStatistics", "ViewerSink"),
            "targets": ("Connect", "Save", "Serve", "Spawn", "Target", "parse_target"),
        },
    )

__all__ = [
    "Canvas",
    "Connect",
    "Save",
    "SceneState",
    "Serve",
    "SinkStatistics",
    "Spawn",
    "Target",
    "ViewOptions",
    "ViewerError",
    "ViewerSink",
    "as_alarm",
    "from_recording",
    "parse_target",
    "visualize",
    "visualizer",
]
