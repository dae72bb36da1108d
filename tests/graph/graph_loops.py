"""A source, an operator for a chain, and one that samples its own output."""

from __future__ import annotations

from collections.abc import Iterator

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Sampled, Source


class Tick(Source):
    t: Out[FeatureVector]

    def stream(self) -> Iterator[dict[str, FeatureVector]]:
        yield from ()


class Sum(Operator):
    tick: In[FeatureVector]
    last: Sampled[FeatureVector] = Sampled(required=False, before=True)
    total: Out[FeatureVector]

    def process(self, tick: FeatureVector, last: FeatureVector | None = None) -> FeatureVector:
        return tick


class Same(Operator):
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return x
