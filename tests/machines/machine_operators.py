"""Operators for graphs over two machines."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Sampled, Source


def numbers(stamp: int, value: float, size: int = 1) -> FeatureVector:
    """A message that holds the same number `size` times."""
    return FeatureVector(stamp=stamp, model="test", labels=("x",), vectors=np.full((1, size), value, np.float32))


class Sensor(Source):
    """Counts at the rate of the clock; stamps are wall time. Dies once in its first life, where it is asked to."""

    real_time = True
    count: Out[FeatureVector]
    constant: Out[FeatureVector] = Out(static=True)
    period: float = Param(0.01, gt=0, doc="seconds")
    steps: int = Param(100, ge=1, doc="how many")
    size: int = Param(1, ge=1, doc="numbers in each")
    dies: str = Param("", doc="a file that is made where it kills its process, once")

    def static_outputs(self) -> Mapping[str, Message]:
        return {"constant": numbers(0, 42.0)}

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.steps):
            if self.dies and k == self.steps // 3 and not Path(self.dies).exists():
                Path(self.dies).touch()
                os.kill(os.getpid(), signal.SIGKILL)
            yield {"count": numbers(time.time_ns(), float(k), self.size)}
            time.sleep(self.period)


class Scale(Operator):
    """Multiplies by the number in a file."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    gain: float = Param(1.0, doc="another factor", tunable=True)
    weights: str = Param("", doc="a file with a number")
    other: str = Param("", doc="any text, or another file")

    def setup(self) -> None:
        self.factor = float(self.use_file(self.weights).read_text()) if self.weights else 2.0
        self.taken = 0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.taken += 1
        return numbers(x.stamp, self.factor * float(x.vectors[0, 0]))

    def summary(self) -> Mapping[str, float | int | str]:
        return {"taken": self.taken, "factor": self.factor}


class Calibrated(Operator):
    """Adds a static message; dies at its fiftieth message in its first life."""

    x: In[FeatureVector]
    constant: Sampled[FeatureVector]
    y: Out[FeatureVector]
    dies: str = Param("", doc="a file that is made where it kills its process")

    def setup(self) -> None:
        self.taken = 0

    def process(self, x: FeatureVector, constant: FeatureVector) -> FeatureVector:
        self.taken += 1
        if self.dies and self.taken == 50 and not Path(self.dies).exists():
            Path(self.dies).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return numbers(x.stamp, float(x.vectors[0, 0] + constant.vectors[0, 0]))

    def summary(self) -> Mapping[str, float | int | str]:
        return {"taken": self.taken}


class Witness(Operator):
    """Shows where it runs; it is not repeated elsewhere."""

    external = True

    x: In[FeatureVector]

    def process(self, x: FeatureVector) -> None:
        """Takes it."""

    def summary(self) -> Mapping[str, float | int | str]:
        return {"folder": os.getcwd()}
