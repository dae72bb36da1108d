"""Images that show nothing new are held back, as operators."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.messages import DepthImage, Diagnostics, Image, Message
from dataflow.operator import In, Operator, Out, Param
from operators.monitoring.watching import MeasurementGate


class ImageWatch(MeasurementGate, Operator):
    """Passes images on unless they are black or repeat the last one, which the status reports.

    A camera that hangs gives its last image with new stamps: what is found in it would be placed where the robot has
    moved to since. Held back, it leaves a gap, which the operators behind know how to bear.
    """

    named = ("image_watch", "image")

    image: In[Image] = In(doc="colour or grey")
    checked: Out[Image] = Out(doc="the same image, if it shows something new")
    status: Out[Diagnostics] = Out(doc="with every image; a warning for one that is held back")

    dark: float = Param(
        6.0, ge=0, le=255, tunable=True, doc="an image of which no more than a hundredth is brighter is black"
    )

    def process(self, image: Image) -> Mapping[str, Message]:
        black = float((image.data[::4, ::4] > self.dark).mean()) <= 0.01
        return self.passed(image, image.data, "is black" if black else None)


class DepthWatch(MeasurementGate, Operator):
    """Passes depth images on unless they have no returns or repeat the last one, which the status reports."""

    named = ("depth_watch", "depth image")

    depth: In[DepthImage] = In(doc="depth, metres")
    checked: Out[DepthImage] = Out(doc="the same image, if it shows something new")
    status: Out[Diagnostics] = Out(doc="with every image; a warning for one that is held back")

    least: float = Param(0.01, ge=0, le=1, tunable=True, doc="least share of pixels with a return")

    def process(self, depth: DepthImage) -> Mapping[str, Message]:
        empty = float(((depth.data > 0) & (depth.data < float("inf"))).mean()) < self.least
        return self.passed(depth, depth.data, "has no returns" if empty else None)
