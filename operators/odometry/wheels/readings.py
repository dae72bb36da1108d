"""Readings of wheel encoders and joints as one number for each side of the robot: metres rolled, or their rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import JointState, WheelTicks

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Reading:
    """Left and right (2,): `rolled` in metres since power-on, or `speed` in m/s; `step` is one count, metres."""

    rolled: Array | None = None
    speed: Array | None = None
    step: float = 0.0

    @property
    def finite(self) -> bool:
        return all(value is None or bool(np.isfinite(value).all()) for value in (self.rolled, self.speed))


def reading(
    message: WheelTicks | JointState, sides: tuple[Sequence[str], Sequence[str]], radius: float | None,
    ticks_per_turn: float | None,
) -> Reading:  # fmt: skip
    """Returns a message's reading of both sides, each the mean of its wheels.

    The message's own radii and resolution go before `radius` (metres) and `ticks_per_turn`. Raises ValueError where a
    wheel or one of them is missing.
    """
    missing = [name for side in sides for name in side if name not in message.names]
    if missing:
        raise ValueError(f"no wheel {missing[0]!r}; there are {', '.join(message.names) or 'none'}")
    places = [[message.names.index(name) for name in side] for side in sides]
    if isinstance(message, WheelTicks):
        radii = _each(message.radii, radius, "radius", len(message.names))
        turn = None if ticks_per_turn is None else ticks_per_turn / (2 * np.pi)
        scale = radii / _each(message.ticks_per_radian, turn, "ticks_per_turn", len(message.names))
        step = float(max(scale[place] for side in places for place in side))
        return Reading(rolled=_sides(message.ticks * scale, places), step=step)
    radii = _each(None, radius, "radius", len(message.names))
    if message.positions is not None:
        return Reading(rolled=_sides(message.positions * radii, places))
    if message.velocities is not None:
        return Reading(speed=_sides(message.velocities * radii, places))
    raise ValueError("the joints have neither positions nor velocities")


def _each(own: Array | None, given: float | None, name: str, count: int) -> Array:
    if own is not None:
        return own
    if given is None:
        raise ValueError(f"the message does not tell the wheels' {name}: set the parameter {name}")
    return np.full(count, given)


def _sides(values: Array, places: list[list[int]]) -> Array:
    return np.array([values[side].mean() for side in places])
