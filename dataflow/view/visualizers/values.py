"""Single values: numbers and switches as curves, texts, alarms and classes as lines; all types without a visualiser."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from dataflow.messages import Alarm, Classification, FeatureVector, Message, Number, Switch, Text
from dataflow.messages.base import ArrayField
from dataflow.view.canvas import Canvas, visualizer

MAX_CURVES = 16
"""Elements of an array up to which each has a curve."""
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


@visualizer(Classification, "status", "log")
def classification(canvas: Canvas, message: Classification) -> None:
    """A lane of classes over time for the image or for each object, and a line of text whenever a class changes."""
    ids = [None] * len(message.class_ids) if message.ids is None else message.ids.tolist()
    for identity, name, score in zip(ids, message.labels(), message.scores.tolist(), strict=True):
        subject = "image" if identity is None else f"object {identity}"
        if canvas.scene.changed(canvas.entity, f"class {subject}", name):
            canvas.log(f"status/{rr.escape_entity_path_part(subject)}", rr.StateChange(state=name))
            canvas.text(f"{subject}: {name} {score:.2f}")


@visualizer(FeatureVector, "tensor")
def feature_vector(canvas: Canvas, message: FeatureVector) -> None:
    """The vectors as rows of an image."""
    if message.vectors.size == 0:
        canvas.clear("tensor")
        return
    canvas.log("tensor", rr.Tensor(message.vectors, dim_names=["vector", "dimension"]))


@visualizer(Message, "plot", "log")
def message(canvas: Canvas, message: Message) -> None:
    """Scalar fields and arrays of a few elements, fixed in number, as curves; all others as a line when they change."""
    words = []
    for field in message.FIELDS:
        name, value = field.name, getattr(message, field.name)
        if value is None:
            continue
        if isinstance(value, (int, float)):
            canvas.plot(name, [float(value)], [name])
        elif isinstance(field, ArrayField) and (count := _curves(field)):
            canvas.plot(name, value.ravel().astype(np.float64), [f"{name} {i}" for i in range(count)])
        elif isinstance(field, ArrayField):
            words.append(f"{name}: {value.dtype.name}{list(value.shape)}")
        else:
            words.append(f"{name}={value!r}")
    text = f"{message.SCHEMA} {', '.join(words)}"
    if words and canvas.scene.changed(canvas.entity, "text", text):
        canvas.text(text)


def _short(stream: str) -> str:
    """The operator and port of a stream's name."""
    return "/".join(stream.split("/")[-2:])


def _curves(field: ArrayField) -> int:
    """Number of curves of an array whose shape is fixed; 0 where it is not, or where there are too many."""
    extents = field.shapes[0]
    if len(field.shapes) > 1 or any(isinstance(extent, str) for extent in extents):
        return 0
    count = math.prod(int(extent) for extent in extents)
    return count if count <= MAX_CURVES else 0
