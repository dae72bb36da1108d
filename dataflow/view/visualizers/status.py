"""Sensors of the robot itself, and the health of the system: curves and text."""

from __future__ import annotations

import math
import re

import numpy as np
import rerun as rr

from dataflow.messages import Diagnostics, Imu, JointState, Level, MagneticField, WheelTicks
from dataflow.messages.geometry import quaternion_to_matrix, roll_pitch_yaw
from dataflow.view.canvas import Canvas, visualizer

_LEVELS = {Level.OK: "INFO", Level.WARN: "WARN", Level.ERROR: "ERROR", Level.STALE: "WARN"}
_LANE = rr.StateConfiguration(
    values=[level.name for level in Level],
    labels=["ok", "warning", "error", "stale"],
    colors=[(60, 170, 90), (230, 180, 40), (215, 60, 60), (130, 135, 145)],
)
_DIGITS = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
_LATENCY = re.compile(r"latency|lag|delay|duration|age|_ms$|_s$|time")
_RATE = re.compile(r"rate|hz|fps|frequency|throughput")


@visualizer(Imu, "plot", plots=("orientation", "gyroscope", "accelerometer"))
def imu(canvas: Canvas, message: Imu) -> None:
    """Curves of the gyroscope and the accelerometer, and of orientation and temperature where they are given."""
    if message.orientation is not None:
        angles = np.degrees(roll_pitch_yaw(quaternion_to_matrix(message.orientation)))
        canvas.plot("orientation", angles, ["roll °", "pitch °", "yaw °"])
    canvas.plot("gyroscope", message.angular_velocity, ["wx rad/s", "wy rad/s", "wz rad/s"])
    canvas.plot("accelerometer", message.linear_acceleration, ["ax m/s²", "ay m/s²", "az m/s²"])
    if message.temperature is not None:
        canvas.plot("temperature", [message.temperature], ["°C"])


@visualizer(MagneticField, "plot")
def magnetic_field(canvas: Canvas, message: MagneticField) -> None:
    """Curves of the field in microtesla."""
    canvas.plot("field", message.field * 1e6, ["x µT", "y µT", "z µT"])


@visualizer(WheelTicks, "plot")
def wheel_ticks(canvas: Canvas, message: WheelTicks) -> None:
    """A curve of the count of each wheel."""
    canvas.plot("ticks", message.ticks.astype(np.float64), message.names)


@visualizer(JointState, "plot")
def joint_state(canvas: Canvas, message: JointState) -> None:
    """Curves of positions, velocities and efforts of each joint."""
    for what in ("positions", "velocities", "efforts"):
        values = getattr(message, what)
        if values is not None:
            canvas.plot(what, values, message.names)


@visualizer(Diagnostics, "status", "log", "plot", plots=("latency", "rate", "value"))
def diagnostics(canvas: Canvas, message: Diagnostics) -> None:
    """A lane from green to red for each status, a line of text when it changes by more than its numbers, and curves.

    Latencies and rates among the numeric values have separate plots.
    """
    for i, name in enumerate(message.names):
        level = Level(int(message.levels[i]))
        lane = f"status/{rr.escape_entity_path_part(name)}"
        if canvas.scene.changed(canvas.entity, lane, level):
            if canvas.scene.once(canvas.stream, lane):
                canvas.log(lane, _LANE, static=True)
            canvas.log(lane, rr.StateChange(state=level.name))
        if canvas.scene.changed(canvas.entity, f"text {name}", (level, _DIGITS.sub("", message.messages[i]))):
            canvas.text(f"{name}: {level.name} {message.messages[i]}".rstrip(), _LEVELS[level])
        for key, value in message.pairs(i).items():
            number = _number(value)
            if number is None:
                continue
            canvas.begin(f"plot/{_kind(key)}")
            path = "/".join(("plot", _kind(key), *map(rr.escape_entity_path_part, (name, key))))
            if canvas.scene.changed(canvas.entity, path, True):
                canvas.log(path, rr.SeriesLines(names=f"{name} {key}"), static=True)
            canvas.log(path, rr.Scalars(number))


def _kind(key: str) -> str:
    """Returns which plot a value belongs to: the same unit, more or less."""
    lower = key.lower()
    if _RATE.search(lower):
        return "rate"
    return "latency" if _LATENCY.search(lower) else "value"


def _number(text: str) -> float | None:
    """The number that a value begins with (`12.5 ms`), or None."""
    try:
        value = float(text.split()[0]) if text.strip() else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None
