"""Operators for tests of faults: a device, one that remembers clock jumps, one that fails for good."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from runtime_operators import number, value

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Sampled, Source


class Device(Source):
    """Counts at the rate of the clock, like a sensor; stamps are wall time."""

    real_time = True
    count: Out[FeatureVector]
    period: float = Param(0.01, gt=0, doc="seconds")
    steps: int = Param(100, ge=1, doc="how many")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.steps):
            yield {"count": value(time.time_ns(), k)}
            time.sleep(self.period)


class Camera(Device):
    """A device that is unplugged once, and has to be opened anew."""

    constant: Out[FeatureVector] = Out(static=True)
    lives = 0

    def setup(self) -> None:
        type(self).lives += 1

    def static_outputs(self) -> Mapping[str, Message]:
        return {"constant": value(0, 42.0)}

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k, step in enumerate(super().stream()):
            if k == 30 and self.lives == 1:
                raise OSError("no such device")
            yield step


class Resets(Operator):
    """Adds up since the last jump of the clock, and counts the jumps."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    def setup(self) -> None:
        self.total, self.resets = 0.0, 0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.total += number(x)
        return value(x.stamp, self.resets, self.total)

    def on_reset(self, input: str) -> None:
        assert input == "x"
        self.total, self.resets = 0.0, self.resets + 1


class Fallback(Operator):
    """Goes on with what it has when the other stream's operator is away, and says so."""

    x: In[FeatureVector]
    other: Sampled[FeatureVector] = Sampled(required=False)
    y: Out[FeatureVector]

    def process(self, x: FeatureVector, other: FeatureVector | None, context) -> FeatureVector:
        return value(x.stamp, float("other" in context.stale), -1.0 if other is None else number(other))


class Doomed(Operator):
    """Fails in every firing."""

    x: In[FeatureVector]

    def process(self, x: FeatureVector) -> None:
        raise RuntimeError("no calibration")


class Noise(Source):
    """16 kB a message that no compression makes smaller; the first number counts."""

    fast: Out[FeatureVector]
    count: int = Param(100, ge=1, doc="how many")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.count):
            noise = np.random.default_rng(k).random(4096, np.float32)
            yield {"fast": value(10**9 + k * 10**7, k, *noise.tolist())}


class Large(Source):
    """1 MB a message, 200 a second; the first number counts."""

    fast: Out[FeatureVector]
    count: int = Param(100, ge=1, doc="how many")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.count):
            stamp = 10**9 + k * 5_000_000
            yield {"fast": FeatureVector(stamp=stamp, vectors=np.full((1, 1 << 18), k, np.float32), model="test")}


class Counting(Operator):
    """Counts what it gets."""

    x: In[FeatureVector]

    def setup(self) -> None:
        self.count = 0

    def process(self, x: FeatureVector) -> None:
        self.count += 1
        self.take(int(x.vectors[0, 0]))

    def take(self, number: int) -> None:
        """Does what is to be done at a message."""

    def summary(self) -> Mapping[str, float]:
        return {"count": self.count}


class Stopped(Counting):
    """Stops its own process (SIGSTOP) at one message."""

    at: int = Param(20, doc="the number of the message")
    file: str = Param(doc="where it writes the number of its process")

    def take(self, number: int) -> None:
        if number == self.at:
            Path(self.file).write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGSTOP)


class Waker(Counting):
    """Lets the process of `Stopped` go on."""

    at: int = Param(300, doc="the number of the message at which it does")
    file: str = Param(doc="where the number of that process is")

    def take(self, number: int) -> None:
        if number == self.at:
            os.kill(int(Path(self.file).read_text()), signal.SIGCONT)
