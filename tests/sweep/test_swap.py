"""The operator that brings a change is found, and A and B are layers of one viewer file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dataflow
from dataflow.graph import Graph
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Param, Source
from dataflow.sweep.plan import SweepError
from dataflow.sweep.swap import ReplayedPair, between, both, parts, shares

FIGURE = "judge: mean error"
STEPS = 12


class Numbers(Source):
    """Counts up."""

    out: Out[FeatureVector]

    def stream(self):
        for step in range(STEPS):
            yield {"out": FeatureVector(stamp=step * 10**7, vectors=np.full((1, 1), step, np.float32), model="m")}


class Plus(Operator):
    """Adds a number."""

    x: In[FeatureVector]
    out: Out[FeatureVector]
    more: float = Param(0.0, doc="what it adds")
    seen: float = Param(0.0, doc="goes into the name of the model, at which the judge does not look")

    def process(self, x: FeatureVector) -> FeatureVector:
        return FeatureVector(stamp=x.stamp, vectors=x.vectors + np.float32(self.more), model=f"m{self.seen}")


class Judge(Operator):
    """The mean of what two branches are off."""

    left: In[FeatureVector]
    right: In[FeatureVector]

    def setup(self) -> None:
        self.total = 0.0

    def process(self, left: FeatureVector, right: FeatureVector) -> None:
        step = left.stamp // 10**7
        self.total += float(left.vectors[0, 0] - step) + float(right.vectors[0, 0] - step)

    def summary(self) -> dict[str, float]:
        return {"mean error": self.total / STEPS}


def graph(left: float = 0.0, behind: float = 0.0, right: float = 0.0, seen: float = 0.0) -> Graph:
    made = dataflow.Graph("swapped").add("numbers", Numbers).add("left", Plus, more=left)
    made.add("behind", Plus, more=behind).add("right", Plus, more=right, seen=seen).add("judge", Judge)
    made.connect("left", x="numbers/out").connect("behind", x="left/out").connect("right", x="numbers/out")
    return made.connect("judge", left="behind/out", right="right/out").build()


def compared(tmp_path: Path, changed: Graph) -> ReplayedPair:
    recording = dataflow.run(graph(), record=tmp_path / "run.mcap").path
    assert recording is not None
    return both(recording, (graph(), changed), (), tmp_path)


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        (graph(left=2.0), {"left": 1.0, "behind": 1.0}),  # what follows carries it on
        (graph(left=1.0, right=3.0), {"left": 0.25, "behind": 0.25, "right": 0.75}),
        (graph(left=2.0, seen=1.0), {"left": 1.0, "behind": 1.0, "right": 0.0}),  # other outputs of no consequence
        (graph(left=2.0, behind=-1.0), {"left": 2.0, "behind": 1.0}),  # made good behind it, in part
    ],
)
def test_the_operator_that_brings_a_change_is_found(tmp_path: Path, changed: Graph, found: dict[str, float]) -> None:
    one = compared(tmp_path, changed)
    makers = {one.graphs[0].streams[stream].node for stream in one.different}
    names = between(one.graphs, [name for name in one.graphs[0].nodes if name in makers], FIGURE)
    told = {share.operator: share.share for share in shares([parts(one, names, FIGURE)] * 2)}
    assert told == pytest.approx(found)


def test_without_an_operator_to_swap_there_is_no_answer() -> None:
    with pytest.raises(SweepError, match="no operator in front of judge has other outputs"):
        between((graph(), graph()), ["judge", "numbers"], FIGURE)


def test_clouds_of_both_are_kept_in_view() -> None:
    from dataflow.sweep.layers import layered

    one = graph()
    one = replace(one, view=replace(one.view, keep=("swapped/right/out", "swapped/left/out")))
    layers, _, _ = layered((one, one), frozenset({"swapped/right/out"}))
    assert set(layers.view.keep) == {"A/right A/out", "B/right B/out", "swapped/left/out"}


def test_a_and_b_are_layers_of_one_file(tmp_path: Path) -> None:
    from dataflow.sweep.layers import draw

    one = compared(tmp_path, graph(right=1.0))
    assert one.different == {"swapped/right/out"}
    counts = draw(one, tmp_path / "layers.rrd").statistics()
    assert (counts.drawn, counts.failed) == (STEPS * (3 + 2), 0)
    told = (tmp_path / "layers.rrd").read_bytes()
    assert b"/A/right\\ A/out" in told
    assert b"/B/right\\ B/out" in told
    assert b"/A/left" not in told
