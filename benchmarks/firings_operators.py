"""Operators for the benchmark of firings: a source that never waits, relays, a sink that measures."""

from __future__ import annotations

import json
import resource
import time
from array import array
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Source

STEP = 1_000_000
VECTORS = np.arange(16, dtype=np.float32).reshape(1, 16)
VECTORS.flags.writeable = False
CHUNK = 20
"""Messages between two looks at the clocks."""


def small(stamp: int) -> FeatureVector:
    """A message of one array of 64 bytes."""
    return FeatureVector(stamp=stamp, vectors=VECTORS, model="")


class Small(Source):
    """Emits small messages as fast as they are taken."""

    out: Out[FeatureVector]
    count: int = Param(1000, doc="how many")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.count):
            yield {"out": small((k + 1) * STEP)}


class Relay(Operator):
    """Answers every message with a new one."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return small(x.stamp)


class Gauge(Operator):
    """Takes messages; sums up what the process has spent on them.

    `marks`: the numbers of messages after which the process's memory is noted.
    """

    x: In[FeatureVector]
    marks: str = Param("[]", doc="JSON list of numbers of messages")

    def setup(self) -> None:
        self.count = 0
        self.looks = array("d")  # flat, so that what is measured hardly grows by being measured
        self.noted = {int(mark): 0.0 for mark in json.loads(self.marks)}

    def process(self, x: FeatureVector) -> None:
        self.count += 1
        if not self.count % CHUNK:
            self.looks.append(time.monotonic())
            self.looks.append(time.process_time())
        if self.count in self.noted:
            self.noted[self.count] = resident()

    def summary(self) -> Mapping[str, float | str]:
        """By message, in seconds: all messages, and the tenth of them that was least disturbed."""
        looks = np.array(self.looks).reshape(-1, 2)
        if len(looks) < 3:
            return {"messages": float(self.count)}
        spent = np.diff(looks, axis=0) / CHUNK
        return {
            "messages": float(self.count),
            "wall": float(spent[:, 0].mean()),
            "cpu": float(spent[:, 1].mean()),
            "wall_best": float(np.quantile(spent[:, 0], 0.1)),
            "cpu_best": float(np.quantile(spent[:, 1], 0.1)),
            "memory": json.dumps(self.noted),
            "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }


class Take(Operator):
    """Takes messages and does nothing: the ends of a fan."""

    x: In[FeatureVector]

    def process(self, x: FeatureVector) -> None:
        return None


def resident() -> float:
    """The resident memory of this process, MiB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20
