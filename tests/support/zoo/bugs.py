"""Ten operators with a bug, each right where the variable ZOO_FIXED is set: what `dataflow capture` is tried on."""

from __future__ import annotations

import math
import os
import zlib
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Source

STAMP = 10**18


def fixed() -> bool:
    return "ZOO_FIXED" in os.environ


def vector(stamp: int, *values: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([values], np.float64), model="bugs")


class Numbers(Source):
    """Numbers at 100 Hz: k, and a number from 0 to 6 without a plain period; a second port has some of them."""

    x: Out[FeatureVector]
    rare: Out[FeatureVector]
    steps: int = Param(1000, ge=1, doc="messages")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.steps):
            stamp = STAMP + k * 10_000_000
            step: dict[str, Message] = {"x": vector(stamp, k, zlib.crc32(str(k).encode()) % 7)}
            if k % 5 < 1 + k % 3:
                step["rare"] = vector(stamp, k)
            yield step


class Bug(Operator):
    """The base: `work` gives the numbers to emit."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return vector(x.stamp, *self.work(float(x.vectors[0, 0]), int(x.vectors[0, 1])))

    def work(self, k: float, kind: int) -> list[float]:
        raise NotImplementedError


class NegativeRoot(Bug):
    """Raises: the root of a negative number."""

    stateless = True

    def work(self, k: float, kind: int) -> list[float]:
        under = 700.0 - k
        return [math.sqrt(max(under, 0.0) if fixed() else under)]


class WrongUnit(Bug):
    """Differs: degrees for radians, beyond a number."""

    stateless = True

    def work(self, k: float, kind: int) -> list[float]:
        return [math.sin(k if fixed() or k < 640 else math.radians(k))]


class TooMany(Bug):
    """Too many outputs, for some inputs."""

    stateless = True

    def work(self, k: float, kind: int) -> list[float]:
        return [k] * (8 if k == 555 and not fixed() else 3)


class LateBatch(Operator):
    """Differs: of several messages the first counts, where the last should."""

    stateless = True
    x: In[FeatureVector]
    rare: Batch[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector, rare: tuple[FeatureVector, ...]) -> FeatureVector:
        which = -1 if fixed() or x.stamp < STAMP + 4 * 10**9 else 0
        return vector(x.stamp, float(rare[which].vectors[0, 0]) if rare else -1)


class EveryTenth(LateBatch, every="100ms"):
    """Raises: a batch of more than some messages."""

    x: Batch[FeatureVector]  # type: ignore[assignment]

    def process(self, x: tuple[FeatureVector, ...], rare: tuple[FeatureVector, ...]) -> FeatureVector:  # type: ignore[override]
        if not fixed() and any(each.vectors[0, 0] == 444 for each in x):
            raise IndexError("no room")
        return vector(x[-1].stamp if x else STAMP, len(rare))


@dataclass
class Sum:
    total: float = 0.0


class Skips(Bug):
    """Differs: a sum that skips a number."""

    state: Sum

    def work(self, k: float, kind: int) -> list[float]:
        if fixed() or k != 613:
            self.state.total += k
        return [self.state.total]


@dataclass
class Tracks:
    ages: dict[int, int] = field(default_factory=dict)
    gone: list[int] = field(default_factory=list)


class Reborn(Bug):
    """Raises: a track that was dropped and comes back."""

    state: Tracks

    def work(self, k: float, kind: int) -> list[float]:
        if k > 500 and kind in self.state.gone:
            if not fixed():
                raise KeyError(kind)
            self.state.gone.remove(kind)
        if kind == 3 and k > 400:
            self.state.gone += [one for one in self.state.ages if one == 5]
            self.state.ages.pop(5, None)
        self.state.ages[kind] = int(k)
        return [len(self.state.ages)]


@dataclass
class Seats:
    taken: int = 0


class BelowZero(Bug):
    """Counts people in a room who were never seen to come in as gone."""

    state: Seats

    def work(self, k: float, kind: int) -> list[float]:
        if kind in (2, 4):
            self.state.taken += 1 if kind == 2 else -1
        if fixed():
            self.state.taken = max(self.state.taken, 0)
        return [self.state.taken]


class Window(Bug):
    """Differs: a mean of the last five that forgets one too many after an equal pair. Has no declared state."""

    def setup(self) -> None:
        self.last: deque[float] = deque(maxlen=5)

    def work(self, k: float, kind: int) -> list[float]:
        self.last.append(kind)
        if not fixed() and k > 800 and len(self.last) > 1 and self.last[-1] == self.last[-2]:
            self.last.popleft()
        return [sum(self.last) / len(self.last)]


class Door(Bug):
    """Raises: it is closed twice. Has no declared state."""

    def setup(self) -> None:
        self.open, self.locked = True, False

    def work(self, k: float, kind: int) -> list[float]:
        if kind == 1 and k > 600:
            if not self.open and self.locked and not fixed():
                raise RuntimeError("closed twice")
            self.open = False
        elif kind == 6:
            self.locked = not self.open
        elif kind == 5:
            self.open, self.locked = True, False
        return [float(self.open)]


class Drifts(Bug):
    """Raises: a sum of the wrong sign, which leaves its range after 52 numbers; all of them are needed to show it."""

    state: Sum

    def work(self, k: float, kind: int) -> list[float]:
        if self.state.total < -5:
            raise ValueError("out of range")
        self.state.total += 0.1 if fixed() else -0.1
        return [self.state.total]


@dataclass(frozen=True)
class Case:
    """How a bug shows: recorded by right code (`differs`), by its own (an error or a predicate)."""

    use: type[Operator]
    differs: bool = False
    predicate: str = ""
    inputs: Mapping[str, str] = field(default_factory=lambda: {"x": "x"})


CASES = (
    Case(NegativeRoot),
    Case(WrongUnit, differs=True),
    Case(TooMany, predicate="out.out.vectors.shape[1] > 5"),
    Case(LateBatch, differs=True, inputs={"x": "rare", "rare": "x"}),
    Case(EveryTenth, inputs={"x": "x", "rare": "rare"}),
    Case(Skips, differs=True),
    Case(Reborn),
    Case(BelowZero, predicate="out.out.vectors[0, 0] < -2"),
    Case(Window, differs=True),
    Case(Door),
)
