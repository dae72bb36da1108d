"""Holds what is done to the robot and its world at given times: faults of sensors, lamps that are switched,
kidnappings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from operators.simulator import settings

SENSORS: dict[str, type[settings.Sensor]] = get_type_hints(settings.Sensors)

FIXED = frozenset({
    "rate", "phase", "outages", "width", "height", "focal", "focal_error", "mount", "offset", "rotation", "baseline",
    "color", "output", "quantum", "rings", "columns", "radius", "track", "ticks_per_turn", "scale_error", "latitude",
    "longitude", "altitude", "gyro_bias", "accel_bias", "gravity", "frame", "ranges",
})  # fmt: skip
"""Parameters that last for the whole run: when a sensor measures, what its messages look like, its calibration."""


def _rising(span: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= span[0] < span[1]:
        raise ValueError(f"a span goes from an earlier to a later time, both ≥ 0, got {span[0]} to {span[1]}")
    return span


Span = Annotated[tuple[float, float], AfterValidator(_rising)]
"""(from, to) in seconds since the start; the end is outside."""


class _Event(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Fault(_Event):
    """A span of time in which a sensor has other parameters: it drops, freezes, goes black, is noisy or knocked."""

    sensor: Literal[
        "color_camera", "depth_camera", "stereo", "lidar", "inertial", "magnetometer", "wheels", "radar", "landmarks",
        "gnss",
    ] = Field(description="the sensor, by its parameter")  # fmt: skip
    span: Span = Field(description="from and to, in seconds since the start")
    set: dict[str, Any] = Field(description="parameters of the sensor and the values that they have in the span")

    @model_validator(mode="after")
    def _known(self) -> Fault:
        wrong = sorted(FIXED & self.set.keys())
        if wrong:
            raise ValueError(f"{', '.join(wrong)} of {self.sensor} cannot change during a run")
        SENSORS[self.sensor].model_validate(self.set)
        return self

    def values(self) -> dict[str, Any]:
        """The parameters by name, as the sensor's own types."""
        parsed = SENSORS[self.sensor].model_validate(self.set)
        return {name: getattr(parsed, name) for name in self.set}


class Lighting(_Event):
    """A span of time in which the lamps shine with a share of their strength."""

    span: Span = Field(description="from and to, in seconds since the start")
    level: float = Field(ge=0, le=2, description="share of their strength with which lamps shine; 0 is off")


class Kidnap(_Event):
    """The robot is carried ahead on its path, in no time; neither wheels nor inertial unit notice."""

    at: float = Field(ge=0, description="when, in seconds since the start")
    ahead: float = Field(gt=0, lt=1, description="how far, as a share of the round")


S = TypeVar("S", bound=settings.Sensor)


class FaultPlan:
    """The parameters of each sensor at a time."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self._faults = [(fault, fault.values()) for fault in faults]
        self._made: dict[tuple[str, tuple[int, ...]], settings.Sensor] = {}

    def at(self, name: str, sensor: S, t: float) -> S:
        """A sensor as it is at a time; where faults overlap, the later in the list decides."""
        active = tuple(
            k
            for k, (fault, _) in enumerate(self._faults)
            if fault.sensor == name and fault.span[0] <= t < fault.span[1]
        )
        if not active:
            return sensor
        key = (name, active)
        if key not in self._made:
            update = {k: v for i in active for k, v in self._faults[i][1].items()}
            self._made[key] = sensor.model_copy(update=update)
        made = self._made[key]
        assert isinstance(made, type(sensor))
        return made


def level_at(lighting: Sequence[Lighting], t: float) -> float:
    """The share of their strength with which lamps shine at a time; the later in the list decides."""
    return next((event.level for event in reversed(lighting) if event.span[0] <= t < event.span[1]), 1.0)


@dataclass(frozen=True)
class Change:
    """Something begins or ends."""

    time: float
    name: str
    text: str
    begins: bool


def changes(faults: Sequence[Fault], lighting: Sequence[Lighting], kidnaps: Sequence[Kidnap]) -> list[Change]:
    """All that begins or ends, by time."""
    found = [Change(k.at, "kidnap", f"carried {k.ahead:g} of the round ahead", True) for k in kidnaps]
    spans: list[tuple[Span, str, str]] = [
        (f.span, f.sensor, ", ".join(f"{k} {v}" for k, v in f.set.items())) for f in faults
    ]
    spans += [(light.span, "lighting", f"lamps at {light.level:g}") for light in lighting]
    for (start, end), name, text in spans:
        found += [Change(start, name, text, True), Change(end, name, text, False)]
    return sorted(found, key=lambda change: (change.time, change.name, change.begins))
