"""Simulated robots whose sensors are off but for those that a test looks at."""

from __future__ import annotations

from typing import Any

from operators.simulator import SimulatedRobot

SMALL = {"width": 64, "height": 48}
QUIET: dict[str, Any] = {"poses": 0, "boxes": False, "relations": 0, "activities": 0}
OFF: dict[str, Any] = {"color_camera": {"rate": 0, **SMALL}, "depth_camera": {"rate": 0}, "truth": QUIET}


def robot(**params: Any) -> SimulatedRobot:
    made = SimulatedRobot(**params)
    made.setup()
    return made


def run(**params: Any) -> dict[str, list[Any]]:
    """What each port of a robot gives."""
    source = robot(**params)
    streams: dict[str, list[Any]] = {port: [m] for port, m in source.static_outputs().items()}
    for step in source.stream():
        for port, message in step.items():
            streams.setdefault(port, []).append(message)
    return streams
