"""An operator with a parameter that a run changes, and a bug, in a graph that is fed by hand."""

from __future__ import annotations

import os
from pathlib import Path

import dataflow
from dataflow.graph import load_text
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Param
from zoo.bugs import STAMP, Sum, fixed, vector

CALLS, CHANGED, WRONG = 800, 605, 608
GRAPH = (
    "graph: tuned\nrecord: {snapshots: 100ms}\noperators:\n"
    "  src: {use: 'zoo.bugs:Numbers'}\n"
    "  tuned: {use: 'zoo.tuned:Tuned', inputs: {x: src/x}}\n"
    "  rare: {use: 'zoo.tuned:Rare', inputs: {x: src/x}}\n"
)


class Tuned(Operator):
    """Differs: a sum of numbers by a factor, which is -1 for one of them."""

    x: In[FeatureVector]
    out: Out[FeatureVector]
    factor: float = Param(1.0, tunable=True, doc="factor")
    state: Sum

    def process(self, x: FeatureVector) -> FeatureVector:
        number = x.vectors[0, 0]
        self.state.total += self.factor * number
        return vector(x.stamp, self.state.total if fixed() or number != WRONG else -1.0)

    def on_reset(self, input: str) -> None:
        self.state.total = 0.0


class Rare(Operator):
    """Emits nothing for 5."""

    stateless = True
    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector | None:
        return None if x.vectors[0, 0] == 5 else vector(x.stamp, *x.vectors[0])


class Counted(Operator):
    """Counts its calls, for the summary."""

    x: In[FeatureVector]
    state: Sum

    def process(self, x: FeatureVector) -> None:
        self.state.total += 1

    def summary(self) -> dict[str, float]:
        return {"calls": self.state.total}


def recorded(path: Path) -> Path:
    """Records numbers at 100 Hz by right code; before `CHANGED` the factor becomes 3."""
    os.environ["ZOO_FIXED"] = "1"
    try:
        with dataflow.Session(load_text(GRAPH), record=path) as session:
            [tuned] = [runner for runner in session._driver.operators if runner.node.name == "tuned"]
            for k in range(CALLS):
                if k == CHANGED:
                    tuned.set_parameter("factor", 3.0)
                stamp = STAMP + k * 10_000_000
                session.put(stamp, {"src/x": vector(stamp, k, 0)})
    finally:
        del os.environ["ZOO_FIXED"]
    return path
