"""Made graphs of three to five operators of which is known what decides each value: selections, joins, state."""

from __future__ import annotations

import random
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

import dataflow
from dataflow.graph import Graph, load_text
from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source

STEPS, SLOW, WINDOW, HALF = 60, 6, 3, 60.0
LOW, HIGH = 31.0, 95.0
LARGE = 33.0
"""Of what `Scale` gives: that of `HALF`."""
SENSORS = ("a", "b", "c", "d")
STAMP, STEP = 10**18, 100_000_000
Sensed = tuple[str, int]
"""A sensor, and the number of its message."""


def reading(seed: int, sensor: str, k: int) -> float:
    """Between 10 and 110."""
    return 10.0 + zlib.crc32(f"{seed}/{sensor}/{k}".encode()) % 1000 / 10.0


def vector(stamp: int, value: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([[value]], np.float64), model="blame")


def number(message: FeatureVector) -> float:
    return float(message.vectors[0, 0])


class Sensors(Source):
    a: Out[FeatureVector]
    b: Out[FeatureVector]
    c: Out[FeatureVector]
    d: Out[FeatureVector]
    slow: Out[FeatureVector]
    seed: int = Param(0, doc="of the readings")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(STEPS):
            stamp = STAMP + k * STEP
            step: dict[str, Message] = {name: vector(stamp, reading(self.seed, name, k)) for name in SENSORS}
            if k % SLOW == SLOW - 1:
                step["slow"] = vector(stamp, k)
            yield step


class Scale(Operator):
    x: In[FeatureVector]
    out: Out[FeatureVector]
    stateless = True

    def process(self, x: FeatureVector) -> FeatureVector:
        return vector(x.stamp, 3.0 + number(x) / 2.0)


class Add(Operator):
    x: In[FeatureVector]
    y: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector, y: FeatureVector) -> FeatureVector:
        return vector(x.stamp, number(x) / 2.0 + number(y) / 2.0)


class Pick(Operator):
    """One of two, by a third."""

    x: In[FeatureVector]
    y: In[FeatureVector]
    by: Sampled[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector, y: FeatureVector, by: FeatureVector) -> FeatureVector:
        return vector(x.stamp, number(x if number(by) >= HALF else y))


@dataclass
class Kept:
    value: float = 0.0


class Keep(Operator):
    """The last one that came with a flag."""

    x: In[FeatureVector]
    flag: Sampled[FeatureVector]
    out: Out[FeatureVector]
    state: Kept

    def process(self, x: FeatureVector, flag: FeatureVector) -> FeatureVector:
        if number(flag) >= HALF:
            self.state.value = number(x)
        return vector(x.stamp, self.state.value)


@dataclass
class Opened:
    open: bool = True


class Latch(Operator):
    """Open from a large reading on until a small one, and at first."""

    x: In[FeatureVector]
    out: Out[FeatureVector]
    state: Opened

    def process(self, x: FeatureVector) -> FeatureVector:
        if not LOW <= number(x) <= HIGH:
            self.state.open = number(x) > HIGH
        return vector(x.stamp, float(self.state.open))


class KeepHalf(Keep):
    """Another version, which gives something else."""

    def process(self, x: FeatureVector, flag: FeatureVector) -> FeatureVector:
        return vector(x.stamp, number(super().process(x, flag)) / 2.0)


class Unsteady(Keep):
    """Gives something else from the second time on that it is given a message."""

    given: ClassVar[set[int]] = set()

    def process(self, x: FeatureVector, flag: FeatureVector) -> FeatureVector:
        made = super().process(x, flag)
        again = x.stamp in self.given
        self.given.add(x.stamp)
        return vector(x.stamp, number(made) + again)


class Fussy(Operator):
    """The input before. Raises at one stamp, and then has forgotten it; what it remembers is no declared state."""

    x: In[FeatureVector]
    out: Out[FeatureVector]
    at: int = Param(0, doc="the number of the step")

    def setup(self) -> None:
        self._latest = 0.0

    def process(self, x: FeatureVector) -> FeatureVector:
        if x.stamp == STAMP + self.at * STEP:
            raise ValueError("not this one")
        before, self._latest = self._latest, number(x)
        return vector(x.stamp, before)


class Either(Operator):
    """Whether one of two is large."""

    x: In[FeatureVector]
    y: In[FeatureVector]
    out: Out[FeatureVector]
    at: float = Param(HALF, doc="the least that is large")

    def process(self, x: FeatureVector, y: FeatureVector) -> FeatureVector:
        return vector(x.stamp, float(number(x) >= self.at or number(y) >= self.at))


class Mean(Operator):
    """The mean of the last ones; what it remembers is no declared state."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        self._last: deque[float] = deque(maxlen=WINDOW)

    def process(self, x: FeatureVector) -> FeatureVector:
        self._last.append(number(x))
        return vector(x.stamp, sum(self._last) / len(self._last))


class Largest(Operator):
    t: In[FeatureVector]
    x: Batch[FeatureVector]
    out: Out[FeatureVector]

    def process(self, t: FeatureVector, x: Sequence[FeatureVector]) -> FeatureVector:
        return vector(t.stamp, max(number(each) for each in x))


@dataclass(frozen=True)
class Decided:
    """A value, what must have decided it, and what may have besides: had a flag been another."""

    value: float
    must: frozenset[Sensed]
    may: frozenset[Sensed] = frozenset()


def _of(value: float, *taken: Decided, may: Sequence[Decided] = ()) -> Decided:
    besides = [each.must | each.may for each in may] + [each.may for each in taken]
    return Decided(value, frozenset().union(*(each.must for each in taken)), frozenset().union(*besides))


def _selected(one: Decided, other: Decided, flag: Decided) -> Decided:
    """The flag decided where the other one is another."""
    return _of(one.value, one, flag) if one.value != other.value else _of(one.value, one, may=[flag])


Stream = list[Decided]


def scale(x: Stream) -> Stream:
    return [_of(3.0 + each.value / 2.0, each) for each in x]


def add(x: Stream, y: Stream) -> Stream:
    return [_of(a.value / 2.0 + b.value / 2.0, a, b) for a, b in zip(x, y, strict=True)]


def pick(x: Stream, y: Stream, by: Stream) -> Stream:
    chosen = [(a, b, flag) if flag.value >= HALF else (b, a, flag) for a, b, flag in zip(x, y, by, strict=True)]
    return [_selected(one, other, flag) for one, other, flag in chosen]


def keep(x: Stream, flag: Stream) -> Stream:
    found, kept, since = [], Decided(0.0, frozenset()), list[Decided]()
    for each, by in zip(x, flag, strict=True):
        since.append(by)
        if by.value >= HALF:
            kept, since = _selected(each, kept, by), []
        found.append(_of(kept.value, kept, may=since))
    return found


def mean(x: Stream) -> Stream:
    parts = [x[max(0, k + 1 - WINDOW) : k + 1] for k in range(len(x))]
    return [_of(sum(each.value for each in part) / len(part), *part) for part in parts]


def largest(x: Stream) -> Stream:
    parts = [x[max(0, k + 1 - SLOW) : k + 1] for k in range(len(x))]
    return [_of(max(each.value for each in p), max(p, key=lambda each: each.value), may=p) for p in parts]


Rule = tuple[Callable[..., Stream], tuple[str, ...]]
LARGEST: Rule = largest, ("x",)
KINDS: dict[str, Rule] = {
    "Scale": (scale, ("x",)),
    "Add": (add, ("x", "y")),
    "Pick": (pick, ("x", "y", "by")),
    "Keep": (keep, ("x", "flag")),
    "Mean": (mean, ("x",)),
}


@dataclass
class Case:
    """A graph, the field to ask for, and what decided it."""

    text: str
    field: str
    truth: Decided
    operators: Sequence[str] = ()


def case(seed: int) -> Case:
    """Draws three to five operators; the value is that of the last one at some time in the second half."""
    draw = random.Random(seed)
    made = {
        f"src/{name}": [Decided(reading(seed, name, k), frozenset({(name, k)})) for k in range(STEPS)]
        for name in SENSORS
    }
    count, last = draw.randint(3, 5), ""
    lines, kinds = [f"  src: {{use: 'blamed_graphs:Sensors', params: {{seed: {seed}}}}}"], []
    ends_slow = draw.random() < 0.3
    for number_ in range(count):
        slow = ends_slow and number_ == count - 1
        kind = draw.choice([*KINDS])
        rule, ports = LARGEST if slow else KINDS[kind]
        kinds.append("Largest" if slow else kind)
        streams = draw.sample([*made], len(ports))
        if last:
            streams = [last, *[s for s in streams if s != last]][: len(ports)]
            streams[1:] = draw.sample([s for s in made if s != last], len(ports) - 1)
            if not slow:
                draw.shuffle(streams)
        if len(ports) > 1 and ports[-1] in ("by", "flag") and not streams[-1].startswith("src/"):
            streams[0], streams[-1] = streams[-1], streams[0]
        if len(ports) > 1 and ports[-1] in ("by", "flag") and not streams[-1].startswith("src/"):
            streams[-1] = draw.choice([s for s in made if s.startswith("src/") and s not in streams])
        inputs = ", ".join(f"{port}: {stream}" for port, stream in zip(ports, streams, strict=True))
        inputs += ", t: src/slow" if slow else ""
        last = f"o{number_}/out"
        made[last] = rule(*(made[stream] for stream in streams))
        lines.append(f"  o{number_}: {{use: 'blamed_graphs:{kinds[-1]}', inputs: {{{inputs}}}}}")
    k = draw.randrange(STEPS // 2, STEPS)
    if ends_slow:
        k = k // SLOW * SLOW - 1
    text = "graph: blamed\nrecord: {topics: [src/*], snapshots: 1s}\noperators:\n" + "\n".join(lines) + "\n"
    truth = made[last][k]
    if ends_slow:
        batch = sorted(each.value for each in made[streams[0]][k + 1 - SLOW : k + 1])
        if batch[-1] == batch[-2]:  # a tie: neither decides alone
            return case(seed + 1000)
        truth = Decided(truth.value, truth.must, truth.may | {("slow", k)})
    return Case(text, at(k, last), truth, kinds)


def graph_of(*operators: str, seed: int = 0) -> Graph:
    """The sensors and operators, each "name | Class | input: stream, ...", of which all streams are recorded."""
    lines = [f"  src: {{use: 'blamed_graphs:Sensors', params: {{seed: {seed}}}}}"]
    for operator in operators:
        name, made, inputs, *more = operator.split(" | ")
        lines.append(
            f"  {name}: {{use: 'blamed_graphs:{made}', inputs: {{{inputs}}}{''.join(', ' + m for m in more)}}}"
        )
    return load_text("graph: blamed\nrecord: {snapshots: 1s}\noperators:\n" + "\n".join(lines) + "\n")


def at(k: int, stream: str) -> str:
    """The field of the value of a stream at a step."""
    return f"{stream}.vectors[0, 0]@{k * STEP * 1e-9 + 0.01:.2f}"


def recorded(one: Case, path: Path) -> Path:
    dataflow.run(load_text(one.text), record=path)
    return path
