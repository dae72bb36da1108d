"""Single values: numbers and switches as curves, texts and alarms as lines of the log."""

from __future__ import annotations

import rerun as rr

from dataflow.messages import Alarm, Number, Switch, Text
from dataflow.view.canvas import Canvas, visualizer

_LEVELS = {"debug": "DEBUG", "info": "INFO", "warning": "WARN", "error": "ERROR", "fatal": "CRITICAL"}


@visualizer(Number, "plot")
def number(canvas: Canvas, message: Number) -> None:
    """A curve named for the stream and the unit."""
    canvas.plot("value", [message.value], [f"{_short(canvas.stream)} {message.unit}".rstrip()])


@visualizer(Text, "log")
def text(canvas: Canvas, message: Text) -> None:
    """A line of text for each message."""
    canvas.text(message.text)


@visualizer(Switch, "plot")
def switch(canvas: Canvas, message: Switch) -> None:
    """A curve of steps between 0 (off) and 1 (on)."""
    if canvas.scene.changed(canvas.entity, "steps", True):
        style = rr.SeriesLines(names=_short(canvas.stream), interpolation_mode="StepAfter")
        canvas.log("plot/on", style, static=True)
    canvas.log("plot/on", rr.Scalars(float(message.on)))


@visualizer(Alarm, "log")
def alarm(canvas: Canvas, message: Alarm) -> None:
    """A line of text in the colour of its level."""
    canvas.text(f"{message.name}: {message.text}".removesuffix(": "), _LEVELS[message.level])


def _short(stream: str) -> str:
    """The operator and port of a stream's name."""
    return "/".join(stream.split("/")[-2:])
