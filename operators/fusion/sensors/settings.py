"""Settings of the sensors of a filter: what each is used for, how far it is believed, and which stream they are for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from dataflow.messages import (
    Imu,
    LandmarkSightings,
    MagneticField,
    Message,
    NavSatFix,
    Odometry,
    Pose,
    RadarScan,
    Twist,
)
from operators.fusion.filter.gate import NEVER_AGREE, GateConfig
from operators.fusion.filter.sensor_errors import SensorErrors

Use = Literal[
    "auto",
    "inertial",
    "control",
    "position",
    "pose",
    "orientation",
    "velocity",
    "wheels",
    "heading",
    "doppler",
    "range",
]
_WITHOUT_PATIENCE = ("doppler", "range")


class SensorSettings(BaseModel):
    """Holds what a stream is used for and how far it is believed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    use: Use = Field("auto", description="what it measures; by the type of its messages if auto")
    offset: float = Field(0.0, ge=-10, le=10, description="seconds by which a measurement is older than its stamp")
    offset_sigma: float = Field(
        0.0, ge=0, le=2, description="seconds by which the offset may be wrong: if above 0, it is estimated"
    )
    drift: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description="standard deviations (east, north, up, m) of an error of positions that changes slowly, included "
        "in the covariance: if above 0, it is estimated",
    )
    drift_time: float = Field(30.0, gt=0, description="seconds in which that error changes")
    scale_sigma: float = Field(
        0.0, ge=0, lt=0.5, description="share by which all speeds of wheels may be wrong: if above 0, it is estimated"
    )
    sigma: float | None = Field(
        None, gt=0, description="standard deviation of what has a length (m, m/s); the message's covariance if none"
    )
    angular_sigma: float | None = Field(
        None, gt=0, description="standard deviation of what turns (rad, rad/s); the message's covariance if none"
    )
    share: float = Field(0.999, gt=0, lt=1, description="share of true measurements that the gate lets through")
    agreeing: int = Field(
        3, ge=2, description="refused measurements that must agree, over a second, until the filter yields"
    )
    lag: float = Field(0.2, gt=0, description="seconds in which velocities follow a control input")
    still: float = Field(0.002, ge=0, description="wheels slower than this (m/s at the rim) stand still")
    azimuth: float = Field(
        math.pi / 2, description="of magnetic north, radians from x towards y; a half π less declination if y is north"
    )

    def gate(self, use: str) -> GateConfig:
        """Returns its gate for this use. What may be of something else than it seems never makes the filter yield."""
        return GateConfig(share=self.share, agreeing=NEVER_AGREE if use in _WITHOUT_PATIENCE else self.agreeing)


DEFAULT_USE: dict[type[Message], Use] = {
    Imu: "inertial",
    NavSatFix: "position",
    Pose: "pose",
    Odometry: "velocity",
    Twist: "velocity",
    MagneticField: "heading",
    RadarScan: "doppler",
    LandmarkSightings: "range",
}
_FITTING: dict[str, tuple[type[Message], ...]] = {
    "inertial": (Imu,),
    "position": (NavSatFix, Pose, Odometry),
    "pose": (Pose, Odometry),
    "orientation": (Imu, Pose, Odometry),
    "velocity": (Odometry, Twist),
    "wheels": (Odometry, Twist),
    "heading": (MagneticField,),
    "control": (Twist,),
    "doppler": (RadarScan,),
    "range": (LandmarkSightings, RadarScan),
}


def use_of(name: str, message: Message, settings: SensorSettings) -> str:
    """Returns what a message is used for. Raises ValueError where it cannot be used so."""
    use = DEFAULT_USE[type(message)] if settings.use == "auto" else settings.use
    if not isinstance(message, _FITTING[use]):
        fitting = " or ".join(t.__name__ for t in _FITTING[use])
        raise ValueError(f"{name}: {type(message).__name__} cannot be used as {use!r}, which takes {fitting}")
    return use


def errors_of(sensors: Mapping[str, SensorSettings]) -> SensorErrors:
    """Returns the lasting errors of sensors that settings ask to be estimated."""
    ordered = sorted(sensors.items())
    return SensorErrors(
        tuple((name, s.offset_sigma) for name, s in ordered if s.offset_sigma),
        tuple((name, s.drift, s.drift_time) for name, s in ordered if any(s.drift)),
        tuple((name, s.scale_sigma) for name, s in ordered if s.scale_sigma),
    )


def unheard(names: Sequence[str], streams: Sequence[str]) -> dict[str, str]:
    """Returns the settings' names that no stream ends with, each with the nearest stream that has no settings."""
    taken = [stream for stream in streams for name in names if f"/{stream}".endswith(f"/{name}")]
    free = [stream for stream in streams if stream not in taken]
    found = {}
    for name in names:
        if not any(f"/{stream}".endswith(f"/{name}") for stream in streams):
            near = get_close_matches(name, free, 1, 0.5)
            found[name] = f"; the nearest is {near[0]}" if near else ""
    return found


def never_yields(gate: GateConfig) -> bool:
    """Returns whether refused measurements that agree with each other are refused all the same."""
    return gate.agreeing == NEVER_AGREE


def name_of(stream: str, sensors: Mapping[str, SensorSettings]) -> str:
    """Returns the name in the settings that a stream's name ends with, else its name without the namespace."""
    for name in sensors:
        if stream == name or stream.endswith(f"/{name}"):
            return name
    return stream.partition("/")[2]
