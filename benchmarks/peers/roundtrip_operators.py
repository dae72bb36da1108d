"""Operators for the round trip: a source that paces itself, a relay in another process, a sink beside the source."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Source

PAUSE = float(os.environ.get("PAUSE", "0.01"))


def vector(stamp: int, numbers: np.ndarray) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=numbers.reshape(1, -1), model="")


class Ping(Source):
    """Sends arrays whose first eight bytes say when, ns on the monotonic clock."""

    real_time = True
    array: Out[FeatureVector]
    nbytes: int = Param(1008, ge=8, doc="bytes of the array")
    count: int = Param(100, ge=1, doc="messages")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        numbers = np.zeros(self.nbytes // 4, np.float32)
        for _ in range(self.count):
            time.sleep(PAUSE)
            numbers[:2] = np.array([time.monotonic_ns()]).view(np.float32)
            yield {"array": vector(time.time_ns(), numbers)}


class Echo(Operator):
    """Answers with the first eight bytes."""

    array: In[FeatureVector]
    answer: Out[FeatureVector]

    def process(self, array: FeatureVector) -> FeatureVector:
        return vector(array.stamp, array.vectors[0, :2].copy())


class Pong(Operator):
    """Takes the answers; sums them up as JSON."""

    answer: In[FeatureVector]

    def setup(self) -> None:
        self.took: list[float] = []

    def process(self, answer: FeatureVector) -> None:
        sent = int(answer.vectors[0].view(np.int64)[0])
        self.took.append((time.monotonic_ns() - sent) / 1e3)

    def summary(self) -> Mapping[str, str]:
        return {"took": json.dumps(self.took)}
