"""Seeing a graph in Rerun: visualisers, blueprint, sinks.

A viewer is an ordinary subscriber: `ViewerSink` draws what it is handed and can neither slow nor end a producer.
"""

from dataflow.view.blueprint import blueprint
from dataflow.view.canvas import Canvas, visualize, visualizer, visualizers
from dataflow.view.playback import as_alarm, from_recording
from dataflow.view.process import ViewerError
from dataflow.view.scene import SceneState, ViewOptions
from dataflow.view.sink import Connect, Save, Serve, SinkStatistics, Spawn, Target, ViewerSink, parse_target

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
    "blueprint",
    "from_recording",
    "parse_target",
    "visualize",
    "visualizer",
    "visualizers",
]
