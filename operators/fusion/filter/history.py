"""Input of the late filter and its record: samples, measurements, and the estimate after each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.control import Command
from operators.fusion.filter.error_state import Noise, State
from operators.fusion.filter.gate import Health
from operators.fusion.filter.measurements import Measurement
from operators.fusion.filter.window import Window

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """Readings of the inertial sensor: time (ns), rad/s (3,), m/s² (3,), and their noise."""

    time: int
    gyro: Array
    accel: Array
    noise: Noise


@dataclass(frozen=True, eq=False)
class Restart:
    """Holds an estimate of a time (ns) that takes the place of the one that measurements made."""

    time: int
    state: State


Entry = Sample | Measurement | Command | Restart


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

    `refuted`: measurements contradict what was told of the first heading; `doubted`: it may be wrong; `moving`:
    nanoseconds in motion so far; `window`: what was felt and measured of late.
    """

    time: int
    hypotheses: tuple[Hypothesis, ...]
    gyro: Array
    accel: Array
    health: Mapping[str, Health] = field(default_factory=dict)
    command: Command | None = None
    refuted: bool = False
    doubted: bool = False
    moving: int = 0
    window: Window = field(default_factory=Window)
