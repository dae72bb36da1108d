"""Operators that reach into others of their process: by a module, a setting of a library, the memory of a message."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import scipy.linalg

from dataflow.messages import FeatureVector, Message
from dataflow.operator import In, Operator, Out, Param, Source

CALLS = {"n": 0}


def vectors(stamp: int, *rows: object) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array(rows, np.float32), model="")


class Matrices(Source):
    """Invertible matrices."""

    out: Out[FeatureVector]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(8):
            yield {"out": vectors(10**9 + k * 10**8, [k + 2, 1], [1, 3])}


class Count(Operator):
    """Counts calls in its module."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        CALLS["n"] += 1
        return vectors(x.stamp, [CALLS["n"]])


class Strict(Operator):
    """Has numpy raise, in the whole process."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        np.seterr(all="raise")

    def process(self, x: FeatureVector) -> FeatureVector:
        return vectors(x.stamp, [0])


class Divide(Operator):
    """Divides by zero."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return vectors(x.stamp, 1 / (0 * x.vectors[0]))


class Solve(Operator):
    """Lets LAPACK work in place on its input, from the firing `since` on, which does not look at the read-only flag."""

    x: In[FeatureVector]
    out: Out[FeatureVector]
    since: int = Param(0, doc="the first firing in which it does")

    def setup(self) -> None:
        self.calls = 0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.calls += 1
        inverse = scipy.linalg.inv(x.vectors.T, overwrite_a=self.calls > self.since)
        return vectors(x.stamp, *inverse)


class Double(Operator):
    """Doubles its input."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return vectors(x.stamp, *(x.vectors * 2))


class Keep(Operator):
    """Writes into the message that it emitted before."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        self.before: FeatureVector | None = None

    def process(self, x: FeatureVector) -> FeatureVector:
        if self.before is not None:
            self.before.vectors.flags.writeable = True
            self.before.vectors[:] = -5
        self.before = vectors(x.stamp, [x.vectors[0, 0]])
        return self.before


class Late(Operator):
    """Adds up the last two inputs, so that it still reads the one before."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        self.before: FeatureVector | None = None

    def process(self, x: FeatureVector) -> FeatureVector:
        before, self.before = self.before, x
        return vectors(x.stamp, [x.vectors[0, 0] + (0 if before is None else before.vectors[0, 0])])
