"""Operators whose results depend on a package of their environment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Source


def number(stamp: int, value: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, model="test", labels=("x",), vectors=np.full((1, 1), value, np.float32))


class Count(Source):
    """Counts to 20."""

    count: Out[FeatureVector]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(20):
            yield {"count": number(k * 1_000_000, float(k))}


class Gain(Operator):
    """Multiplies by the number of the package `tiny`, which only environments have."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    def setup(self) -> None:
        import tiny

        self.gain = tiny.GAIN

    def process(self, x: FeatureVector) -> FeatureVector:
        return number(x.stamp, self.gain * float(x.vectors[0, 0]))
