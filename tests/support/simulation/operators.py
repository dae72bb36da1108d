"""Operators for simulated runs: small, with every kind of input; how long their work takes is simulated too."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source

START = 1_700_000_000_000_000_000
REFUSES = 3
"""The revision of an operator's code that does not take the states of those before."""


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

    real_time = True

    def stream(self) -> Iterator[Mapping[str, Message]]:
        begun = Effort.now()
        for k in range(self.count):
            Effort.sleep(max(0.0, begun + k * self.period * 1e-9 - Effort.now()))
            stamp = round(Effort.now() * 1e9)
            step = {"fast": value(stamp, k)}
            if k % self.ratio == 0:
                step["slow"] = value(stamp, -k)
            yield step


class Revised:
    """Marks an operator whose code may be replaced while it runs (`reloading`); `revision` numbers the code."""

    revision: ClassVar[int] = 0


class Relay(Revised, Operator):
    """Passes on what it gets, with noise."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def process(self, x: FeatureVector) -> FeatureVector:
        labour(x.stamp, self.work)
        return value(x.stamp, number(x) + self.rng.normal() + 1000 * self.revision)


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


class Smooth(Revised, Operator, every="25ms"):
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
        return value(context.stamp, self.state, self.calls, float(context.tick), self.revision)

    def snapshot(self) -> Any:
        return {"state": self.state, "calls": self.calls, "revision": self.revision}

    def restore(self, state: Any) -> None:
        if REFUSES == self.revision != state["revision"]:
            raise ValueError("a state of another kind")
        self.state, self.calls = state["state"], state["calls"]

    def finish(self) -> FeatureVector | None:
        return value(2 * START, self.state)


class Mean(Smooth):
    """As `Smooth`, without a last message, which lies far ahead: for graphs with other timers."""

    def finish(self) -> None:
        return None


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


class Pair(Counter):
    """Gives on one port, then on the other."""

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for step in super().stream():
            k = int(number(step["fast"]))  # type: ignore[arg-type]
            yield {"fast": step["fast"]} if k % 2 else {"slow": step["fast"]}


class JumpingPair(Device):
    """Gives on one port, then on the other; in its middle its clock jumps back, between the two."""

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for step in super().stream():
            message = step["fast"]
            k = int(number(message))  # type: ignore[arg-type]
            message = message if k < self.count // 2 else message.replace(stamp=message.stamp - 300_000_000)
            yield {"fast": message} if k % 2 else {"slow": message}


class Loop(Operator):
    """Samples what it gave last, and what another stream gave last."""

    x: In[FeatureVector]
    last: Sampled[FeatureVector] = Sampled(before=True, required=False)
    beside: Sampled[FeatureVector] = Sampled(required=False)
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def process(self, x: FeatureVector, last: FeatureVector | None, beside: FeatureVector | None) -> FeatureVector:
        labour(x.stamp, self.work)
        known = [0.0 if message is None else number(message) for message in (last, beside)]
        return value(x.stamp, (number(x) + 0.5 * known[0] + known[1]) % 1000)


class LoopedBatch(Operator):
    """Samples what it gave last, and takes all that another stream gave since; it gives nothing for some."""

    x: In[FeatureVector]
    last: Sampled[FeatureVector] = Sampled(before=True, required=False)
    rest: Batch[FeatureVector]
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def process(
        self, x: FeatureVector, last: FeatureVector | None, rest: tuple[FeatureVector, ...]
    ) -> FeatureVector | None:
        labour(x.stamp, self.work)
        before = 0.0 if last is None else number(last)
        return None if len(rest) % 5 == 3 else value(x.stamp, (before + number(x) + sum(map(number, rest))) % 1000)


class Delayed(Operator):
    """Looks at what was 20 ms ago, if it is not too old."""

    x: In[FeatureVector]
    old: Sampled[FeatureVector] = Sampled(before="20ms", max_age="60ms", required=False)
    y: Out[FeatureVector]

    def process(self, x: FeatureVector, old: FeatureVector | None) -> FeatureVector:
        return value(x.stamp, number(x) if old is None else (number(x) + number(old)) % 1000)


class Lagging(Operator):
    """Gives stamps 7 ms before those that it fires at."""

    x: In[FeatureVector]
    y: Out[FeatureVector] = Out(lag="10ms")

    def process(self, x: FeatureVector) -> FeatureVector:
        return value(x.stamp - 7_000_000, number(x))


class Leading(Operator):
    """Gives stamps 2 ms after those that it fires at, and every second one on another port too."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    half: Out[FeatureVector]

    def process(self, x: FeatureVector) -> Mapping[str, FeatureVector]:
        made = value(x.stamp + 2_000_000, number(x))
        return {"y": made, "half": made} if int(number(x)) % 2 else {"y": made}


class Near(Operator, tolerance="3ms"):
    """Joins three streams by nearest stamp."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    c: In[FeatureVector]
    y: Out[FeatureVector]
    work: float = Param(0.0, ge=0, doc="longest time that a call takes, s")

    def process(self, a: FeatureVector, b: FeatureVector, c: FeatureVector) -> FeatureVector:
        labour(a.stamp, self.work)
        return value(a.stamp, (number(a) + 2 * number(b) + 3 * number(c)) % 1000)


class Both(Operator):
    """Joins two streams by equal stamps."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, a: FeatureVector, b: FeatureVector) -> FeatureVector:
        return value(a.stamp, (number(a) - number(b)) % 1000)


class Either(Operator, merge=True):
    """Fires for each of two streams, and counts how often their clock jumped back."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    y: Out[FeatureVector]

    def setup(self) -> None:
        self.jumps = 0

    def on_reset(self, input: str) -> None:
        self.jumps += 1

    def process(self, a: FeatureVector | None, b: FeatureVector | None, context: Any) -> FeatureVector:
        there = [number(message) for message in (a, b) if message is not None]
        return value(context.stamp, (sum(there) + self.jumps) % 1000)


class Beat(Operator, every="10ms"):
    """Ticks where there is a fresh message, with the newest three of another stream."""

    x: Sampled[FeatureVector] = Sampled(max_age="30ms")
    rest: Batch[FeatureVector] = Batch(max=3)
    y: Out[FeatureVector]

    def process(self, x: FeatureVector, rest: tuple[FeatureVector, ...], context: Any) -> FeatureVector:
        return value(context.stamp, (number(x) + len(rest)) % 1000)


class Placed(Operator):
    """Needs a static message, and can be tuned; what it gives is large."""

    x: In[FeatureVector]
    constant: Sampled[FeatureVector]
    y: Out[FeatureVector]
    gain: float = Param(1.0, doc="factor", tunable=True)
    size: int = Param(3000, ge=1, doc="numbers in each message")

    def process(self, x: FeatureVector, constant: FeatureVector) -> FeatureVector:
        return value(x.stamp, *[(number(x) * self.gain + number(constant)) % 1000] * self.size)


class Arm(Operator):
    """Touches the world: what it gives is taken from the recording when others are executed again."""

    external = True
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return value(x.stamp, number(x))


class Hoard(Revised, Operator):
    """Remembers much: its states are large."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    size: int = Param(4000, ge=1, doc="numbers that it remembers")

    def setup(self) -> None:
        self.memory = np.zeros(self.size)

    def process(self, x: FeatureVector) -> FeatureVector:
        self.memory = np.roll(self.memory, 1) * 0.97 + self.rng.normal(size=self.size)
        return value(x.stamp, number(x), float(self.memory.sum()), self.revision)

    def snapshot(self) -> Any:
        return self.memory

    def restore(self, state: Any) -> None:
        self.memory = np.array(state)
