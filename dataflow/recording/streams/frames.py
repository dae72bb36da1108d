"""The frame tree for other people's viewers: where odometry has put each frame, and one root above all frames.

Foxglove's pose messages name the frame they are given in, but not the frame that they place; and Rerun's importer draws
only what is connected to its root frame. So a recording carries, besides its streams, a channel of FrameTransforms that
is derived from them. Our own reader leaves it out: it holds nothing that the streams do not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dataflow.messages import Message, Odometry, Transforms

VIEWER_ROOT = "tf#/"
"""The name that Rerun's importer gives the frame of its root."""


class FrameTree:
    """Derives the transforms that messages imply, one message after the other."""

    def __init__(self) -> None:
        self._placed_by: dict[str, str] = {}
        self._roots: set[str] = set()

    def transforms(self, stream: str, message: Message) -> Iterator[Transforms]:
        """The transforms to write beside `message`: its own when it is the first stream to place that frame, and the
        link from the viewer's root to a frame that nothing places."""
        if isinstance(message, Odometry):
            places_one = message.child_frame not in ("", message.frame)
            if places_one and self._placed_by.setdefault(message.child_frame, stream) == stream:
                link = self._root(message.frame)
                own = Transforms(
                    stamp=message.stamp,
                    frames=(message.frame,),
                    child_frames=(message.child_frame,),
                    translations=message.position[np.newaxis],
                    rotations=message.orientation[np.newaxis],
                )
                yield own if link is None else _joined(own, link)
        elif isinstance(message, Transforms):
            for child in message.child_frames:
                self._placed_by.setdefault(child, stream)

    def _root(self, frame: str) -> str | None:
        """`frame` when it has to be linked to the viewer's root now."""
        if frame in self._placed_by or frame in self._roots:
            return None
        self._roots.add(frame)
        return frame


def _joined(own: Transforms, root: str) -> Transforms:
    return Transforms(
        stamp=own.stamp,
        frames=(*own.frames, VIEWER_ROOT),
        child_frames=(*own.child_frames, root),
        translations=np.vstack([own.translations, [0.0, 0.0, 0.0]]),
        rotations=np.vstack([own.rotations, [0.0, 0.0, 0.0, 1.0]]),
    )
