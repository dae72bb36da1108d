"""Operators for graphs that are built in Python."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import Alarm, Image, Message, Number
from dataflow.operator import In, Operator, Out, Param, Sampled, Source

MS = 1_000_000


class Camera(Source):
    """Gives images that grow brighter."""

    image: Out[Image] = Out(doc="a grey image")
    exposure: Out[Number] = Out(doc="every second time")

    frames: int = Param(6, ge=0, doc="number of images")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for i in range(self.frames):
            stamp = (i + 1) * 100 * MS
            image = Image(stamp=stamp, frame="camera", data=np.full((4, 6), 40 * i, np.uint8))
            yield {"image": image} | ({"exposure": Number(stamp=stamp, value=float(i))} if i % 2 else {})


class Photometer(Operator):
    """Measures how bright images are, with noise."""

    image: In[Image] = In(doc="what is measured")
    brightness: Out[Number] = Out(doc="mean of the pixels")

    gain: float = Param(1.0, gt=0, doc="factor")

    def process(self, image: Image) -> Number:
        noise = float(self.rng.normal(0.0, 1e-3))
        return Number(stamp=image.stamp, value=self.gain * float(image.data.mean()) + noise)


class Judge(Operator):
    """Warns of brightness above a limit."""

    brightness: In[Number] = In(doc="to be judged")
    exposure: Sampled[Number] = Sampled(doc="at that time")
    alarm: Out[Alarm] = Out(doc="above the limit")

    limit: float = Param(100.0, doc="warned above")

    def setup(self) -> None:
        self.given = 0

    def process(self, brightness: Number, exposure: Number) -> Alarm | None:
        if brightness.value <= self.limit:
            return None
        self.given += 1
        return Alarm(stamp=brightness.stamp, level="warning", name="light", text=f"exposure {exposure.value:g}")

    def summary(self) -> dict[str, float]:
        return {"alarms": self.given}


class Counting(Operator):
    """Counts images."""

    image: In[Image] = In(doc="taken")
    count: Out[Number] = Out(doc="images so far")

    def setup(self) -> None:
        self.taken = 0

    def process(self, image: Image) -> Number:
        self.taken += 1
        return Number(stamp=image.stamp, value=float(self.taken))


class Interrupting(Counting):
    """Presses Ctrl-C at the third image."""

    def process(self, image: Image) -> Number:
        if self.taken == 2:
            signal.raise_signal(signal.SIGINT)
        return super().process(image)


class Broken(Operator):
    """Fails at the third image."""

    image: In[Image] = In(doc="taken")

    def process(self, image: Image) -> None:
        if image.stamp >= 300 * MS:
            raise ValueError("the third image")
