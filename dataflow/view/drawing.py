"""Draws messages by the visualisers of their classes, the built-in ones and those of other packages."""

from __future__ import annotations

import numpy as np
import rerun as rr
from rerun.error_utils import catch_and_log_exceptions

import dataflow.view.visualizers  # noqa: F401  (registers the built-in ones)
from dataflow.messages import Message, Tracks
from dataflow.view.canvas import PLOTS, ROLES, VISUALIZERS, Canvas, Role
from dataflow.view.scene import TIMELINE, SceneState


def roles_of(message_type: type[Message]) -> tuple[Role, ...]:
    """In which views a type appears."""
    return next((ROLES[c] for c in message_type.__mro__ if c in ROLES), ())


def plots_of(message_type: type[Message]) -> tuple[str, ...]:
    """Returns the plots with separate axes."""
    return next((PLOTS[c] for c in message_type.__mro__ if c in PLOTS), ())


def parts_of(message_type: type[Message]) -> tuple[str, ...]:
    """Returns what messages of a type may draw or not: `plot/NAME` of curves, `space` of tracks without positions."""
    space = ("space",) if issubclass(message_type, Tracks) else ()
    return (*space, *(f"plot/{name}" for name in plots_of(message_type)))


def visualize(
    recording: rr.RecordingStream, entity: str, message: Message, scene: SceneState, stream: str = ""
) -> None:
    """Draws `message` at `entity` on the timeline `stamp`; `stream` defaults to the entity's own name.

    Sets the calling thread's time on `recording`. Raises whatever the visualiser raises: a message that cannot be drawn
    must not pass for one that was drawn. Of a stream that is only to place frames nothing is drawn.
    """
    draw = next(VISUALIZERS[c] for c in type(message).__mro__ if c in VISUALIZERS)
    recording.set_time(TIMELINE, timestamp=np.datetime64(message.stamp, "ns"))
    if scene.begin is None and stream not in scene.layout.static:
        scene.begin = message.stamp
    canvas = Canvas(recording, entity, stream or entity.lstrip("/"), message.stamp, scene)
    with catch_and_log_exceptions(strict=True):  # this thread only: Rerun otherwise turns errors into warnings
        if canvas.stream in scene.layout.placing:
            canvas.place_frames(message)
        else:
            draw(canvas, message)
