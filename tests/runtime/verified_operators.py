"""Operators that stand in for a `Smooth` that somebody changed, each in another way."""

from __future__ import annotations

import os
from collections.abc import Mapping

from runtime_operators import Broken, Merge, Smooth, Sum, number

from dataflow.messages import FeatureVector


class Nudged(Smooth):
    """Adds a tiny number to one element, from the fifth call on: what another machine's rounding might do."""

    NUDGE = 1e-6

    def process(self, x: FeatureVector | None, context) -> FeatureVector | None:
        made = super().process(x, context)
        if made is None or self.calls < 5:
            return made
        vectors = made.vectors.copy()
        vectors[0, 2] += self.NUDGE
        return made.replace(vectors=vectors)


class Chatty(Nudged):
    """Nudged, and emits where it had been silent."""

    def process(self, x: FeatureVector | None, context) -> FeatureVector | None:
        made = super().process(x, context)
        if made is None:
            made = FeatureVector(stamp=context.stamp, vectors=[[0.0]], model="test")
        return made


class Moody(Smooth):
    """Other numbers every time: bytes of the system's generator, which nobody seeds."""

    def process(self, x: FeatureVector | None, context) -> FeatureVector | None:
        made = super().process(x, context)
        if made is None or self.calls < 5:
            return made
        return made.replace(vectors=made.vectors + int.from_bytes(os.urandom(2)))


class Unable(Smooth):
    """Cannot be set up."""

    def setup(self) -> None:
        raise FileNotFoundError("no weights for it")


class Doubled(Broken):
    """A pass-through that somebody changed."""

    def process(self, x: FeatureVector) -> FeatureVector:
        return x.replace(vectors=x.vectors * 2)


class BrokenOtherwise(Broken):
    """A pass-through that fails where it did, in another way."""

    def process(self, x: FeatureVector) -> FeatureVector:
        if number(x) == self.at:
            raise KeyError("gripper")
        return super().process(x)


class MergeDoubled(Merge):
    """`Merge` that somebody changed."""

    def process(self, all: Mapping[str, FeatureVector]) -> FeatureVector:
        made = super().process(all)
        return made.replace(vectors=made.vectors * 2)


class SumHalved(Sum):
    """A sink that somebody changed."""

    def summary(self) -> Mapping[str, float]:
        found = super().summary()
        return {**found, "total": found["total"] / 2}
