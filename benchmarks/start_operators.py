"""Operators for the benchmark of starting: a source as quick as an IMU, and a sink that notes its first message."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Source

VECTORS = np.arange(16, dtype=np.float32).reshape(1, 16)


class Steady(Source):
    """Emits a small message a hundred times a second."""

    out: Out[FeatureVector]
    count: int = Param(20, doc="how many")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.count):
            time.sleep(0.01)
            yield {"out": FeatureVector(stamp=(k + 1) * 10_000_000, vectors=VECTORS, model="")}


class Pass(Operator):
    """Hands on what it is given."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return x


class First(Operator):
    """Notes when its first message came: seconds on the clock that all processes of this machine share."""

    x: In[FeatureVector]

    def setup(self) -> None:
        self.first = 0.0

    def process(self, x: FeatureVector) -> None:
        self.first = self.first or time.monotonic()

    def summary(self) -> Mapping[str, float]:
        return {"first": self.first}
