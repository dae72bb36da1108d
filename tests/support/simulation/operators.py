"""Operators for simulated runs: small, with every kind of input; how long their work takes is simulated too."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source

START = 1_700_000_000_000_000_000


def _no_time(seconds: float) -> None:
    """Takes no time: outside of a simulated run."""


class Effort:
    """How work takes time here; a simulated run sets it."""

    sleep: Callable[[float], Any] = staticmethod(_no_time)
    now: Callable[[], float] = staticmethod(lambda: START * 1e-9)


def labour(stamp: int, most: float) -> None:
    """Takes up to `most` seconds, by the stamp: mostly little, now and then all of it."""
    if most > 0:
        share = (stamp // 1000 * 2654435761 % 2**32) / 2**32
        Effort.sleep(most * share**4)


def value(stamp: int, *numbers: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([numbers], np.float32).reshape(1, -1), model="test")


def number(message: FeatureVector) -> float:
    return float(message.vectors[0, 0])


class Counter(Source):
    """Counts on `fast`; every `ratio`-th step also on `slow`."""

    fast: Out[FeatureVector]
    slow: Out[FeatureVector]
    constant: Out[FeatureVector] = Out(static=True)
    count: int = Param(30, ge=0, doc="how many steps")
    period: int = Param(10_000_000, gt=0, doc="step, ns")
    ratio: int = Param(5, gt=0, doc="steps to a message on slow")
    offset: int = Param(0, ge=0, doc="ns before the first step")
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def static_outputs(self) -> Mapping[str, Message]:
        return {"constant": value(0, 42.0)}

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.count):
            stamp = START + self.offset + k * self.period
            labour(stamp, self.work)
            step = {"fast": value(stamp, k)}
            if k % self.ratio == 0:
                step["slow"] = value(stamp, -k)
            yield step


class Device(Counter):
    """As `Counter`, but with the stamps of the clock: it cannot wait."""

    live = True

    def stream(self) -> Iterator[Mapping[str, Message]]:
        begun = Effort.now()
        for k in range(self.count):
            Effort.sleep(max(0.0, begun + k * self.period * 1e-9 - Effort.now()))
            stamp = round(Effort.now() * 1e9)
            step = {"fast": value(stamp, k)}
            if k % self.ratio == 0:
                step["slow"] = value(stamp, -k)
            yield step


class Relay(Operator):
    """Passes on what it gets, with noise."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def process(self, x: FeatureVector) -> FeatureVector:
        labour(x.stamp, self.work)
        return value(x.stamp, number(x) + self.rng.normal())


class Timer(Operator, every="250us"):
    """Says what it last got, many times between two messages."""

    x: Sampled[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x: FeatureVector, context: Any) -> FeatureVector:
        return value(context.stamp, number(x))


class Mix(Operator, tolerance="3ms"):
    """Joins two streams by nearest stamp, samples a static stream and its own past, batches the first."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    constant: Sampled[FeatureVector]
    feedback: Sampled[FeatureVector] = Sampled(before=True, required=False)
    recent: Batch[FeatureVector]
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def process(
        self,
        a: FeatureVector,
        b: FeatureVector,
        constant: FeatureVector,
        feedback: FeatureVector | None,
        recent: tuple[FeatureVector, ...],
    ) -> FeatureVector:
        labour(a.stamp, self.work)
        return value(
            a.stamp,
            number(a) + 2 * number(b) + number(constant),
            0.0 if feedback is None else number(feedback),
            sum(number(m) for m in recent),
            len(recent),
        )


class Smooth(Operator, every="25ms"):
    """A running mean, on every message and on a timer: it has state, and sometimes emits nothing."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def setup(self) -> None:
        self.state, self.calls = 0.0, 0

    def process(self, x: FeatureVector | None, context: Any) -> FeatureVector | None:
        labour(context.stamp, self.work)
        self.calls += 1
        if x is not None:
            self.state = 0.9 * self.state + 0.1 * number(x)
        if self.calls % 7 == 3:
            return None
        return value(context.stamp, self.state, self.calls, float(context.tick))

    def snapshot(self) -> Any:
        return {"state": self.state, "calls": self.calls}

    def restore(self, state: Any) -> None:
        self.state, self.calls = state["state"], state["calls"]

    def finish(self) -> FeatureVector:
        return value(2 * START, self.state)


class Merge(Operator, merge=True):
    """Every message of every stream it can get, in stamp order."""

    all: In[FeatureVector] = In(many=True)
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def setup(self) -> None:
        self.total = 0.0

    def process(self, all: Mapping[str, FeatureVector]) -> FeatureVector:
        stamp = max(m.stamp for m in all.values())
        labour(stamp, self.work)
        self.total += sum(number(m) * (k + 1) for k, m in enumerate(all.values()))
        return value(stamp, self.total, len(all))


class Pose(Operator):
    """Gives one static stream and takes a dynamic one: whoever samples it may have to wait for it."""

    x: In[FeatureVector]
    mount: Out[FeatureVector] = Out(static=True)

    def static_outputs(self) -> Mapping[str, Message]:
        return {"mount": value(0, 7.0)}

    def process(self, x: FeatureVector) -> None:
        return None


class Sum(Operator):
    """A sink that says what it saw."""

    x: In[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def setup(self) -> None:
        self.count, self.total = 0, 0.0

    def process(self, x: FeatureVector) -> None:
        labour(x.stamp, self.work)
        self.count += 1
        self.total += number(x)

    def summary(self) -> Mapping[str, Any]:
        return {"count": self.count, "total": self.total}
