"""Topics as Foxglove shows them: a stream's own, and the frames that its messages place."""

from __future__ import annotations

from collections.abc import Iterator

from dataflow.messages import Message
from dataflow.recording.streams.frames import FrameTree

FRAMES = "/frames"


class Topics:
    """Names topics `/operator/port`, without the namespace, and derives the transforms that Foxglove cannot know."""

    def __init__(self, namespace: str = "") -> None:
        self._prefix = f"{namespace}/" if namespace else ""
        self._frames = FrameTree()

    def of(self, stream: str, message: Message) -> Iterator[tuple[str, Message]]:
        """Yields what is shown for a message: topic and message, its own last."""
        for transforms in self._frames.transforms(stream, message):
            yield FRAMES, transforms
        yield f"/{stream.removeprefix(self._prefix).lstrip('/')}", message
