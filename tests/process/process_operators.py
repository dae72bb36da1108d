"""Operators for tests of one process."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Source


class Unplugged(BaseException):
    """An exception that is no `Exception`, as drivers may raise."""


def value(stamp: int, number: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([[number]], np.float32), model="test")


class Count(Source):
    """Counts, and raises at `fails_at` in each of its first `failures` lives."""

    real_time = True
    count: Out[FeatureVector]
    number: int = Param(10, ge=0, doc="how many")
    fails_at: int = Param(-1, doc="where")
    lives = 0
    closed: ClassVar[list[str]] = []

    def stream(self) -> Iterator[Mapping[str, Message]]:
        type(self).lives += 1
        first = (self.lives - 1) * 100
        for k in range(self.number):
            if k == self.fails_at:
                raise Unplugged("no such device")
            yield {"count": value(1000 + first + k, k)}

    def close(self) -> None:
        self.closed.append(threading.current_thread().name)


class Blocks(Source):
    """Waits for `let_go` after its first step, as a driver waits for an image, and notes the order of its ends."""

    real_time = True
    count: Out[FeatureVector]
    waiting = threading.Event()
    let_go = threading.Event()
    ends: ClassVar[list[tuple[str, str]]] = []

    def stream(self) -> Iterator[Mapping[str, Message]]:
        try:
            yield {"count": value(1000, 0)}
            self.waiting.set()
            self.let_go.wait(60)
            yield {"count": value(1001, 1)}
        finally:
            self.ends.append(("stream", threading.current_thread().name))

    def close(self) -> None:
        self.ends.append(("close", threading.current_thread().name))


class Twice(Operator):
    """Doubles."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return value(x.stamp, 2 * float(x.vectors[0, 0]))


class Weird(Operator):
    """Raises what is no `Exception`, with a text of 50 MB."""

    x: In[FeatureVector]

    def process(self, x: FeatureVector) -> None:
        raise Unplugged("x" * 50_000_000)
