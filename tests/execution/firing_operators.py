"""Small operators, and what drives a single runner on messages made by hand."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dataflow.execution.protocol import Runner
from dataflow.graph.model import Live, Node
from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled
from dataflow.records.firing import FiringRecord
from dataflow.sync import Entry


def value(stamp: int, number: float = 0.0) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([[number]], np.float64), model="test")


def entry(stream: str, stamp: int, seq: int, incarnation: int = 0) -> Entry:
    message = value(stamp, seq)
    return Entry(stamp, message, seq, incarnation, message.digest(), stream)


class Collector:
    """An emitter that keeps everything."""

    def __init__(self) -> None:
        self.records: list[FiringRecord] = []
        self.messages: list[Message] = []
        self.promised: list[tuple[str, int]] = []
        self.ended: list[str] = []

    def message(self, stream: str, entry: Entry) -> None:
        self.messages.append(entry.value)

    def frontier(self, stream: str, frontier: int) -> None:
        self.promised.append((stream, frontier))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self.ended.append(stream)

    def record(self, record: FiringRecord) -> None:
        self.records.append(record)

    @property
    def numbers(self) -> list[float]:
        return [float(m.vectors[0, 0]) for m in self.messages if isinstance(m, FeatureVector)]

    def kinds(self) -> list[str]:
        return [record.kind for record in self.records]


class Returned(Collector):
    """Also gives the runner what it emits, as its process does with what an operator takes from itself."""

    runner: Runner

    def message(self, stream: str, entry: Entry) -> None:
        super().message(stream, entry)
        self.runner.push(stream, entry)

    def frontier(self, stream: str, frontier: int) -> None:
        super().frontier(stream, frontier)
        self.runner.advance(stream, frontier)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        super().end(stream, final_stamp, reason)
        self.runner.end(stream, final_stamp, reason)


def node(cls: type[Operator], inputs: Mapping[str, Iterable[str]], live: Live | None = None, **fields: Any) -> Node:
    return Node(
        name="n",
        use=f"firing_operators:{cls.__name__}",
        params=fields.pop("params", {}),
        inputs={name: tuple(streams) for name, streams in inputs.items()},
        outputs={port: f"t/n/{port}" for port in cls.spec.outputs},
        live=live or Live("newest", 16, dict.fromkeys(inputs, 0)),
        every=cls.spec.every,
        **fields,
    )


def run_all(runner: Runner) -> None:
    while runner.step():
        pass


class Echo(Operator):
    """Repeats its input."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return x


class Pair(Operator):
    """Joins two streams."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, a: FeatureVector, b: FeatureVector) -> FeatureVector:
        return a


class Either(Operator, merge=True):
    """Fires for each of two streams."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    resets: int = 0

    def on_reset(self, input: str) -> None:
        self.resets += 1

    def process(self, a: FeatureVector | None, b: FeatureVector | None) -> None:
        return None


class Looks(Operator):
    """Needs a static message and looks at another stream."""

    x: In[FeatureVector]
    constant: Sampled[FeatureVector]
    image: Sampled[FeatureVector] = Sampled(required=False)
    y: Out[FeatureVector]

    def process(self, x: FeatureVector, constant: FeatureVector, image: FeatureVector | None) -> FeatureVector:
        return x


class Gathers(Operator):
    """Takes all since the last firing."""

    x: In[FeatureVector]
    rest: Batch[FeatureVector]

    def process(self, x: FeatureVector, rest: tuple[FeatureVector, ...]) -> None:
        return None


class Loop(Operator):
    """Adds its input to what it last gave."""

    x: In[FeatureVector]
    last: Sampled[FeatureVector] = Sampled(required=False, before=True)
    rest: Batch[FeatureVector]
    y: Out[FeatureVector]

    def process(
        self, x: FeatureVector, last: FeatureVector | None, rest: tuple[FeatureVector, ...]
    ) -> FeatureVector | None:
        before = 0.0 if last is None else float(last.vectors[0, 0])
        return value(x.stamp, before + float(x.vectors[0, 0]))


class Timer(Operator, every="13ms"):
    """Counts ticks."""

    x: Sampled[FeatureVector] = Sampled(required=False)
    y: Out[FeatureVector]

    def process(self, x: FeatureVector | None, context: Any) -> FeatureVector:
        return value(context.stamp)


class Strict(Operator, every="13ms"):
    """Ticks only where it has a message."""

    x: Sampled[FeatureVector] = Sampled(max_age="13ms")

    def process(self, x: FeatureVector) -> None:
        return None


class Dice(Operator):
    """Draws wherever it is called: from its own generator and, with `shared`, from the global ones."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    gain: float = Param(1.0, doc="factor", tunable=True)
    shared: bool = Param(False, doc="also draws from the global generators")

    def setup(self) -> None:
        self.total = self._draw()

    def on_parameter(self, name: str) -> None:
        self.changed = self._draw()

    def on_reset(self, input: str) -> None:
        self.total = self._draw()

    def process(self, x: FeatureVector) -> FeatureVector:
        self.total += self._draw() * self.gain + getattr(self, "changed", 0.0)
        return value(x.stamp, self.total)

    def snapshot(self) -> Mapping[str, Any]:
        return {"total": self.total, "next": self._draw()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.total = state["total"]

    def summary(self) -> Mapping[str, float]:
        return {"drawn": self._draw()}

    def _draw(self) -> float:
        drawn = float(self.rng.random())
        return drawn + random.random() + float(np.random.random()) if self.shared else drawn
