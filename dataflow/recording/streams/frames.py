"""The frame tree for other people's viewers: where odometry has put each frame, and one root above all frames.

Foxglove's pose messages name the frame they are given in, but not the frame that they place; and Rerun's importer draws
only what is connected to its root frame. So a recording carries, besides its streams, a channel of FrameTransforms that
is derived from them. Our own reader leaves it out: it holds nothing that the streams do not.
"""

from __future__ import annotations

import numpy as np

from dataflow.messages import Message, Odometry, Transforms
from dataflow.recording.layout import SEQUENCE_SPAN, Kind, frames_topic
from dataflow.recording.mcap.container import ContainerWriter
from dataflow.recording.streams.codecs import codec_for
from dataflow.recording.streams.foxglove import Parts

VIEWER_ROOT = "tf#/"
"""The name that Rerun's importer gives the frame of its root."""


class FrameTree:
    """Derives the transforms that messages imply, one message after the other."""

    def __init__(self) -> None:
        self._placed_by: dict[str, str] = {}
        self._roots: set[str] = set()

    def transforms(self, stream: str, message: Message) -> Transforms | None:
        """The transforms to write beside `message`: its own when it is the first stream to place that frame, and the
        link from the viewer's root to a frame that nothing places."""
        if isinstance(message, Transforms):
            for child in message.child_frames:
                self._placed_by.setdefault(child, stream)
        if not isinstance(message, Odometry) or message.child_frame in ("", message.frame):
            return None
        if self._placed_by.setdefault(message.child_frame, stream) != stream:
            return None
        rows = [(message.frame, message.child_frame, message.position, message.orientation)]
        if message.frame not in self._placed_by and message.frame not in self._roots:
            self._roots.add(message.frame)
            rows.append((VIEWER_ROOT, message.frame, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
        frames, child_frames, translations, rotations = zip(*rows, strict=True)
        return Transforms(
            stamp=message.stamp,
            frames=frames,
            child_frames=child_frames,
            translations=np.array(translations),
            rotations=np.array(rotations),
        )


class FrameChannel:
    """The channel of derived transforms in a file, which is declared with the first of them."""

    def __init__(self, file: ContainerWriter, namespace: str) -> None:
        self._file, self._namespace = file, namespace
        self._tree, self._codec = FrameTree(), codec_for(Transforms)
        self._channel = self._count = 0

    def derived(self, stream: str, message: Message) -> list[tuple[int, int, int, Parts]]:
        """The transforms that a message implies, as `ContainerWriter.add_messages` takes them."""
        transforms = self._tree.transforms(stream, message)
        if transforms is None:
            return []
        if not self._channel:
            text, encoding = self._codec.schema, self._codec.message_encoding
            schema = self._file.add_schema(text.name, text.encoding, text.data)
            self._channel = self._file.add_channel(
                frames_topic(self._namespace), encoding, schema, {"kind": str(Kind.FRAMES)}
            )
        self._count += 1
        parts, _ = self._codec.encode(transforms)
        return [(self._channel, message.stamp, (self._count - 1) % SEQUENCE_SPAN, parts)]
