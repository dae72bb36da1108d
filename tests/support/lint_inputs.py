"""LintInput with planted faults: made by hand, or by the simulated robot, which knows the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from dataflow.lint.inputs import Finding, Stamps, StreamFacts
from dataflow.messages import Message

SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND


class MadeInput:
    """Messages by stream, in the order given; or timestamps alone."""

    namespace = "robot1"

    def __init__(
        self, messages: Mapping[str, Sequence[Message]], stamps: Mapping[str, Sequence[int]] | None = None
    ) -> None:
        self._messages, self._stamps = messages, dict(stamps or {})
        facts = {
            name: StreamFacts(type(found[0]).SCHEMA, name.endswith("extrinsics"), len(found), True)
            for name, found in messages.items()
        }
        facts |= {name: StreamFacts("Other", False, len(found), False) for name, found in self._stamps.items()}
        self.streams = facts

    def file_findings(self, *, whole: bool) -> Iterator[Finding]:
        return iter(())

    def stamps(self, stream: str) -> Stamps:
        found = self._stamps.get(stream)
        return np.array([m.stamp for m in self._messages[stream]] if found is None else found, np.int64)

    def messages(self, stream: str) -> Iterator[Message]:
        return iter(self._messages[stream])


def every(period: float, first: float = 0.0, last: float = 10.0) -> list[int]:
    """Timestamps `period` seconds apart, from `first` to `last` seconds."""
    return [BEGIN + round(t * SECOND) for t in np.arange(first, last, period)]


@cache
def _simulated(sensors: str) -> dict[str, list[Message]]:
    from operators.simulator import SimulatedRobot

    settings: dict[str, Any] = {
        "seed": 4,
        "movers": False,
        "first_stamp": BEGIN,
        "duration": "30s",
        "color_camera": {"rate": 0, "width": 64, "height": 48},
        "depth_camera": {"rate": 0},
        "inertial": {"rate": 100},
        "wheels": {"rate": 20},
        "truth": {"poses": 20, "boxes": False, "relations": 0, "activities": 0},
    }
    for name, values in json.loads(sensors).items():
        settings[name] = settings[name] | values
    robot = SimulatedRobot(**settings)
    robot.setup()
    streams: dict[str, list[Message]] = {f"robot1/{port}": [m] for port, m in robot.static_outputs().items()}
    for step in robot.stream():
        for port, message in step.items():
            streams.setdefault(f"robot1/{port}", []).append(message)
    return streams


def simulated(**sensors: Any) -> dict[str, list[Message]]:
    """The streams of a simulated robot without cameras: gyroscope, wheels, true poses; sensors as given."""
    return _simulated(json.dumps(sensors, sort_keys=True))
