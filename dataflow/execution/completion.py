"""Fills in what operators left out of the messages that they return: the firing's stamp and the anchor's frame."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.messages.base import Message, complete, lacking
from dataflow.operator import OperatorSpec, OutputError
from dataflow.sync import Firing
from dataflow.sync.entries import entries_of


def complete_outputs(spec: OperatorSpec, outputs: Mapping[str, Message], firing: Firing) -> None:
    """Completes what `process()` or `finish()` returned, by port. Raises `OutputError` where the anchor has no frame.

    The anchor is the message that triggered the firing: of joined inputs the first. Merged inputs, and one with
    `many=True`, may fire at several messages at once, which then need to be of one frame.
    """
    for port, message in outputs.items():
        if missing := lacking(message):
            complete(message, firing.stamp, _frame(spec, firing, port, message) if missing != ["stamp"] else "")


def require_complete(spec: OperatorSpec, outputs: Mapping[str, Message], given_by: str) -> None:
    """Raises `OutputError` for a message that lacks its stamp or frame where no firing has them."""
    for port, message in outputs.items():
        if missing := lacking(message):
            raise OutputError(
                f"{spec.name}.{port} emitted {message.SCHEMA} without {' and '.join(missing)}: {given_by} is no "
                f"firing that has them; give {', '.join(f'{name}=...' for name in missing)}"
            )


def _frame(spec: OperatorSpec, firing: Firing, port: str, message: Message) -> str:
    anchors: dict[str, Message] = {}
    for trigger in spec.triggers:
        anchors |= {e.stream or trigger.name: e.value for e in entries_of(firing.inputs.get(trigger.name))}
        if anchors and not spec.merge:
            break
    frames = {name: getattr(anchor, "frame", None) for name, anchor in anchors.items()}
    found = set(frames.values())
    if len(found) == 1 and isinstance(frame := found.pop(), str):
        return frame
    if not anchors:
        why = "finish() has no anchor" if firing.kind == "finish" else "no message triggered the firing, but a tick"
    elif len(anchors) == 1:
        (anchor,) = anchors.values()
        why = f"the anchor, a {anchor.SCHEMA}, has none"
    else:
        why = "the messages that triggered it differ: " + ", ".join(f"{n} {frame!r}" for n, frame in frames.items())
    raise OutputError(f"{spec.name}.{port} emitted {message.SCHEMA} without frame, and {why}; give frame=...")
