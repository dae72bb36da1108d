"""Operators for tests of latency: a source, a relay, a join and a sink on a timer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Sampled, Source


class Device(Source):
    """Never runs here."""

    value: Out[FeatureVector]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        return iter(())


class Relay(Operator):
    """Passes on."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return x


class Join(Operator):
    """Takes two; what it samples causes nothing."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    hint: Sampled[FeatureVector] = Sampled(required=False)

    def process(self, a: FeatureVector, b: FeatureVector, hint: FeatureVector | None) -> None:
        return None


class Gather(Operator, every="1s"):
    """Fires on a timer."""

    recent: Batch[FeatureVector]

    def process(self, recent: tuple[FeatureVector, ...]) -> None:
        return None
