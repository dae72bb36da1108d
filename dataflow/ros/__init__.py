"""Topics of ROS 2 in and out of a live graph over Zenoh, without ROS: the wire of rmw_zenoh.

`use: dataflow.ros:Imu` is a source of Imu messages of a topic, and so for every type that bags are read as;
`dataflow.ros:StaticTransforms` is one of a latched topic (`/tf_static`), as a static stream. `Ros2Source` passes
messages of any type on as they are (`RosMessage`), and `Ros2Sink` publishes.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PLACES = {"Ros2Source": "source", "Ros2Sink": "sink", "RosMessage": "message"}


def __getattr__(name: str) -> Any:
    """The operators, and the source of messages of a type, made when it is first asked for."""
    if name in _PLACES:
        return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    if name.startswith("_"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from dataflow.interop.conversions import CONVERSIONS
    from dataflow.interop.ros.to_ros2 import OUTWARD
    from dataflow.ros.source import source_of

    known = {kind.__name__: kind for kind in (*OUTWARD, *(to for _, to in CONVERSIONS))}
    static = name.removeprefix("Static")
    if static not in known:
        raise AttributeError(f"module {__name__!r} has no source {name!r}; it has one for {', '.join(sorted(known))}")
    made = source_of(known[static], latched=static != name)
    globals()[name] = made
    return made
