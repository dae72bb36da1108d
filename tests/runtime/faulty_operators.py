"""Operators for tests of faults: a device, one that remembers clock jumps, one that fails for good."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import numpy as np
from runtime_operators import number, value

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Sampled, Source


class Device(Source):
    """Counts at the rate of the clock, like a sensor; stamps are wall time."""

    live = True
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

    def process(self, x: FeatureVector, other: FeatureVector | None, context) -> FeatureVector:  # type: ignore[no-untyped-def]
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
