"""Message types without a visualiser: numbers as curves, the rest as text."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import Message
from dataflow.messages.base import ArrayField
from dataflow.view.canvas import Canvas, visualizer

MAX_CURVES = 16
"""Elements of an array up to which each has a curve."""


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


def _curves(field: ArrayField) -> int:
    """Number of curves of an array whose shape is fixed; 0 where it is not, or where there are too many."""
    extents = field.shapes[0]
    if len(field.shapes) > 1 or any(isinstance(extent, str) for extent in extents):
        return 0
    count = math.prod(int(extent) for extent in extents)
    return count if count <= MAX_CURVES else 0
