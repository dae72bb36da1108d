"""Operators for the benchmark of firings: a source that never waits, relays, a sink that measures."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Source

STEP = 1_000_000
VECTORS = np.arange(16, dtype=np.float32).reshape(1, 16)
VECTORS.flags.writeable = False
WARM_UP = 20


def small(stamp: int) -> FeatureVector:
    """A message of one array of 64 bytes."""
    return FeatureVector(stamp=stamp, vectors=VECTORS, model="")


class Small(Source):
    """Emits small messages as fast as they are taken, for some seconds or up to a number."""

    out: Out[FeatureVector]
    seconds: float = Param(2.0, doc="how long", unit="s")
    count: int = Param(0, doc="messages instead, where not 0")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        stamp = STEP
        yield {"out": small(stamp)}  # is read ahead, before the run begins
        until = time.monotonic() + self.seconds
        while stamp < self.count * STEP if self.count else time.monotonic() < until:
            stamp += STEP
            yield {"out": small(stamp)}


class Relay(Operator):
    """Answers every message with a new one."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return small(x.stamp)


class Gauge(Operator):
    """Takes messages; sums up what the process has spent between the first ones and the last.

    `marks`: the numbers of messages after which the process's memory is noted.
    """

    x: In[FeatureVector]
    marks: str = Param("[]", doc="JSON list of numbers of messages")

    def setup(self) -> None:
        self.count = 0
        self.noted = {int(mark): 0.0 for mark in json.loads(self.marks)}

    def process(self, x: FeatureVector) -> None:
        self.count += 1
        if self.count == WARM_UP:
            self.began, self.began_cpu = time.monotonic(), time.process_time()
        self.ended, self.ended_cpu = time.monotonic(), time.process_time()
        if self.count in self.noted:
            self.noted[self.count] = resident()

    def summary(self) -> Mapping[str, float | str]:
        if self.count <= WARM_UP:
            return {"messages": 0.0}
        return {
            "messages": float(self.count - WARM_UP),
            "wall": self.ended - self.began,
            "cpu": self.ended_cpu - self.began_cpu,
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
