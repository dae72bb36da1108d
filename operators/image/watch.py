"""Images that show nothing new are held back, as operators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.messages import DepthImage, Diagnostics, Image, Message
from dataflow.operator import In, Operator, Out, Param
from operators.watching import Watcher


class ImageWatch(Operator):
    """Passes images on unless they are black or repeat the last one, and says so.

    A camera that hangs gives its last image with new stamps: what is found in it would be placed where the robot has
    moved to since. Held back, it leaves a gap, which the operators behind know how to bear.
    """

    image: In[Image] = In(doc="colour or grey")
    checked: Out[Image] = Out(doc="the same image, if it shows something new")
    status: Out[Diagnostics] = Out(doc="with every image; a warning for one that is held back")

    dark: float = Param(
        6.0, ge=0, le=255, live=True, doc="an image of which no more than a hundredth is brighter is black"
    )

    def setup(self) -> None:
        self._watcher = Watcher("image_watch", "image")

    def process(self, image: Image) -> Mapping[str, Message]:
        black = float((image.data[::4, ::4] > self.dark).mean()) <= 0.01
        flaw = self._watcher.judge(image.data, "is black" if black else None)
        status = self._watcher.status(image.stamp, flaw)
        return {"status": status} if flaw else {"checked": image, "status": status}

    def on_reset(self, input: str) -> None:
        """The clock began anew; the same image may come again."""
        self._watcher.last = b""

    def snapshot(self) -> Mapping[str, Any]:
        return self._watcher.snapshot()

    def restore(self, state: Mapping[str, Any]) -> None:
        self._watcher.restore(state)

    def summary(self) -> Mapping[str, int]:
        return dict(self._watcher.counts)


class DepthWatch(Operator):
    """Passes depth images on unless they have no returns or repeat the last one, and says so."""

    depth: In[DepthImage] = In(doc="depth, metres")
    checked: Out[DepthImage] = Out(doc="the same image, if it shows something new")
    status: Out[Diagnostics] = Out(doc="with every image; a warning for one that is held back")

    least: float = Param(0.01, ge=0, le=1, live=True, doc="least share of pixels with a return")

    def setup(self) -> None:
        self._watcher = Watcher("depth_watch", "depth image")

    def process(self, depth: DepthImage) -> Mapping[str, Message]:
        empty = float((depth.data > 0).mean()) < self.least
        flaw = self._watcher.judge(depth.data, "has no returns" if empty else None)
        status = self._watcher.status(depth.stamp, flaw)
        return {"status": status} if flaw else {"checked": depth, "status": status}

    def on_reset(self, input: str) -> None:
        """The clock began anew; the same image may come again."""
        self._watcher.last = b""

    def snapshot(self) -> Mapping[str, Any]:
        return self._watcher.snapshot()

    def restore(self, state: Mapping[str, Any]) -> None:
        self._watcher.restore(state)

    def summary(self) -> Mapping[str, int]:
        return dict(self._watcher.counts)
