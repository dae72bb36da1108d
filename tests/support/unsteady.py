"""Operators that do not repeat: within a process, and from one to the next."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import ClassVar

from dataflow.messages import Message, Number
from dataflow.operator import In, Operator, Out, Source


class Count(Source):
    x: Out[Number]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(10):
            yield {"x": Number(stamp=k, value=float(k))}


class CountsCalls(Operator):
    """Adds how many calls its process has made of it: as a clock, it goes on."""

    x: In[Number]
    out: Out[Number]
    stateless = True
    made: ClassVar[list[int]] = []

    def process(self, x: Number) -> Number:
        self.made.append(x.stamp)
        return Number(value=x.value + len(self.made))


class Entropy(Operator):
    x: In[Number]
    out: Out[Number]
    stateless = True

    def process(self, x: Number) -> Number:
        return Number(value=x.value + int.from_bytes(os.urandom(6)))


class Hashes(Operator):
    """Adds a hash of a text, which is another in each process."""

    x: In[Number]
    out: Out[Number]
    stateless = True

    def process(self, x: Number) -> Number:
        return Number(value=x.value + hash("unsteady") % 1000)
