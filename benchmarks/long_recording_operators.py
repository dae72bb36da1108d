"""Operators of `long_recording.py` and `long_verification.py`: a source, and operators with and without a state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Param, Source

EPOCH = 1_700_000_000 * 10**9
PERIOD = 500_000_000
"""Between two messages, ns."""


def numbered(stamp: int, number: int) -> FeatureVector:
    """A message that holds a number."""
    return FeatureVector(stamp=stamp, vectors=np.full((1, 1), number, np.float32), model="")


class Pulse(Source):
    """Emits numbers."""

    out: Out[FeatureVector]
    count: int = Param(20, ge=1, doc="how many")

    def stream(self) -> Iterator[Mapping[str, FeatureVector]]:
        for k in range(self.count):
            yield {"out": numbered(EPOCH + k * PERIOD, k % 1000)}


class Sum(Operator):
    """Counts what it is given."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        self.calls = 0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.calls += 1
        return numbered(x.stamp, self.calls % 1000)

    def snapshot(self) -> Mapping[str, Any]:
        return {"calls": self.calls}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.calls = state["calls"]


class Copy(Operator):
    """Sends what it is given."""

    stateless = True
    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return x
