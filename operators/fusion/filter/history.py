"""Input of the late filter and its record: samples, measurements, and the estimate after each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.control import Command
from operators.fusion.filter.error_state import Noise, State
from operators.fusion.filter.gate import Doubt, Health
from operators.fusion.filter.measurements import Model

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """Readings of the inertial sensor: time (ns), rad/s (3,), m/s² (3,), and their noise."""

    time: int
    gyro: Array
    accel: Array
    noise: Noise


@dataclass(frozen=True, eq=False)
class Measurement:
    """Holds a sensor's measurement of a time (ns), with covariance (M, M).

    `clock`: which of the state's time offsets is the sensor's, -1 for none; `assumed`: seconds taken for it in `time`.
    """

    time: int
    sensor: str
    model: Model
    noise: Array
    clock: int = -1
    assumed: float = 0.0


Entry = Sample | Measurement | Command


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One of several estimates, with the logarithm of its weight.

    `against`: what was told of the first heading, which it is followed against for a time in motion.
    """

    weight: float
    state: State
    against: bool = False


@dataclass(frozen=True, eq=False)
class Node:
    """The estimate after an entry: its time (ns), the readings of that time, and what became of each sensor.

    `refuted`: measurements contradict what was told of the first heading; `moving`: nanoseconds in motion so far.
    """

    time: int
    hypotheses: tuple[Hypothesis, ...]
    gyro: Array
    accel: Array
    health: Mapping[str, Health] = field(default_factory=dict)
    command: Command | None = None
    refuted: bool = False
    moving: int = 0


def plain_node(node: Node) -> dict[str, Any]:
    """Returns a node as numbers, texts, arrays, and lists and mappings of these."""
    c = node.command
    return {
        "time": node.time,
        "readings": [node.gyro, node.accel],
        "command": None if c is None else [c.time, c.linear, c.angular, c.lag],
        "hypotheses": [
            [h.weight, *(getattr(h.state, f.name) for f in fields(State)), h.against] for h in node.hypotheses
        ],
        "health": {
            name: [
                *(h.used, h.widened, h.refused, h.unconfirmed, h.last_used, h.nis),
                [[d.time, d.residual, d.noise, d.kind] for d in h.doubts],
                *(h.nis_sum, h.freedom, h.streak, h.leap, h.room),
            ]
            for name, h in node.health.items()
        },
        "refuted": node.refuted,
        "moving": node.moving,
    }


def node_of(content: Mapping[str, Any]) -> Node:
    """Returns the node that `plain_node` was given."""
    size = len(fields(State))
    hypotheses = tuple(
        Hypothesis(float(weight), State(*values[:size]), *(bool(against) for against in values[size:]))
        for weight, *values in content["hypotheses"]
    )
    health = {}
    for name, (used, widened, refused, unconfirmed, last, nis, doubts, *sums) in content["health"].items():
        kept = tuple(Doubt(int(time), *rest) for time, *rest in doubts)
        health[name] = Health(used, widened, refused, unconfirmed, last, nis, kept, *sums)
    gyro, accel = content["readings"]
    told = content.get("command")
    command = None if told is None else Command(int(told[0]), told[1], told[2], float(told[3]))
    refuted, moving = bool(content.get("refuted", False)), int(content.get("moving", 0))
    return Node(int(content["time"]), hypotheses, gyro, accel, health, command, refuted, moving)


def plain_sample(sample: Sample) -> list[Any]:
    """Returns a sample as numbers and arrays."""
    noise = sample.noise
    return [sample.time, sample.gyro, sample.accel, noise.gyro, noise.accel, noise.gyro_walk, noise.accel_walk]


def sample_of(content: Sequence[Any]) -> Sample:
    """Returns the sample that `plain_sample` was given."""
    time, gyro, accel, *noise = content
    return Sample(int(time), gyro, accel, Noise(*noise))
