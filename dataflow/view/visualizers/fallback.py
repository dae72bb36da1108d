"""Message types that nobody wrote a visualiser for: numbers as curves, the rest as text."""

from __future__ import annotations

from dataflow.messages import Message
from dataflow.view.canvas import Canvas, visualizer


@visualizer(Message, "plot", "log")
def message(canvas: Canvas, message: Message) -> None:
    """Scalar fields as curves of their own; all fields as one line of text when they change."""
    words = []
    for name, value in message.items():
        if isinstance(value, (int, float)) and name != "stamp":
            canvas.plot(name, [float(value)], [name])
        elif name != "stamp" and value is not None:
            shape = getattr(value, "shape", None)
            words.append(f"{name}={value!r}" if shape is None else f"{name}: {list(shape)}")
    text = f"{message.SCHEMA} {', '.join(words)}".strip()
    if canvas.scene.changed(canvas.entity, "text", text):
        canvas.text(text)
