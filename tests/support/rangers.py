"""A range finder with one spike, or with lost echoes, and what is made of its readings."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from dataflow.messages import Message, Number, RangeReading, Switch, Text
from dataflow.operator import In, Operator, Out, Param, Source

STEPS, STEP, SPIKE = 60, 100_000_000, 24


def spiky(k: int) -> float:
    return 1000.0 if k == SPIKE else 3.0 + 0.01 * math.sin(k)


def approaching(k: int) -> float:
    """A wall of which near by every other echo is lost."""
    distance = 4.0 - 0.05 * k
    return math.inf if distance < 2.2 and k % 2 else distance


class Finder(Source):
    range: Out[RangeReading]
    approaches: bool = Param(default=False, doc="whether it approaches a wall")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(STEPS):
            distance = approaching(k) if self.approaches else spiky(k)
            yield {"range": RangeReading(stamp=k * STEP, frame="finder", range=distance)}


@dataclass
class Mean:
    value: float | None = None


class Smooth(Operator):
    range: In[RangeReading]
    out: Out[Number]
    state: Mean

    def process(self, range: RangeReading) -> Number:
        before = self.state.value
        self.state.value = range.range if before is None else before + 0.2 * (range.range - before)
        return Number(value=self.state.value)


class Guard(Operator):
    """Trips for ever; what it remembers is no declared state."""

    value: In[Number]
    stop: Out[Switch]
    limit: float = Param(50.0, doc="largest value")

    def setup(self) -> None:
        self._tripped = False

    def process(self, value: Number) -> Switch:
        self._tripped |= value.value > self.limit
        return Switch(on=self._tripped)


@dataclass
class Readings:
    last: list[float] = field(default_factory=list)


class Brake(Operator):
    """Stops before what is nearer than 2 m by the median of three readings."""

    range: In[RangeReading]
    stop: Out[Switch]
    state: Readings

    def process(self, range: RangeReading) -> Switch:
        self.state.last = [*self.state.last, range.range][-3:]
        return Switch(on=statistics.median(self.state.last) < 2.0)


def told(distance: float) -> str:
    return f"a wall at {distance:.3f} m"


class Describe(Operator):
    """Asks a service about each reading."""

    range: In[RangeReading]
    text: Out[Text]

    def process(self, range: RangeReading) -> Text:
        return Text(text=self.effect(told, range.range))


READINGS = (2.0, 3.0, 4.0, 150.0, 1.0, 150.5, 160.0)


class Beaten(Source):
    """Readings, and a beat behind them."""

    reading: Out[Number]
    beat: Out[Number]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k, value in enumerate(READINGS):
            yield {"reading": Number(stamp=k * STEP, value=value)}
        yield {"beat": Number(stamp=len(READINGS) * STEP, value=0.0)}


@dataclass
class Seen:
    value: float | None = None


class Watch(Operator):
    """Passes on what is not the reading before: a sensor that hangs gives it again."""

    reading: In[Number]
    fresh: Out[Number]
    state: Seen

    def process(self, reading: Number) -> Number | None:
        hangs, self.state.value = reading.value == self.state.value, reading.value
        return None if hangs else reading


@dataclass
class LastTwo:
    values: list[float] = field(default_factory=list)


class AnyHigh(Operator, merge=True):
    """Whether one of the last two values is high."""

    fresh: In[Number]
    beat: In[Number]
    high: Out[Switch]
    state: LastTwo

    def process(self, fresh: Number | None, beat: Number | None) -> Switch:
        if fresh is not None:
            self.state.values = [*self.state.values, fresh.value][-2:]
        return Switch(on=any(value > 100.0 for value in self.state.values))
