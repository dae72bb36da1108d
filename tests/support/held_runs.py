"""Live runs on a clock that is turned by hand: messages come late, operators stand still, all of it recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.api.local import Emitting, Recorder
from dataflow.execution.driver import Driver
from dataflow.execution.live import LiveRunner
from dataflow.execution.log import FiringLog
from dataflow.graph import Graph, load_text
from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source
from dataflow.records.firing import Emission
from dataflow.api.runs import metadata_of
from dataflow.sync import NEVER, Entry

STAMP, MS = 10**18, 1_000_000
Held = Mapping[tuple[str, int], int]
"""By stream and number of a message, by how many ms it comes late."""


def vector(stamp: int, *values: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([values], np.float32), model="held")


class Drive(Source):
    """Steps of a motion at 50 Hz, turns at 25 Hz, and where it truly is at 10 Hz."""

    step: Out[FeatureVector]
    turn: Out[FeatureVector]
    truth: Out[FeatureVector]
    steps: int = Param(1000, doc="steps")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        at = 0.0
        for k in range(self.steps):
            stamp = STAMP + k * 20 * MS
            at += moved(k) * turned(k // 2)
            out: dict[str, Message] = {"step": vector(stamp, moved(k))}
            if k % 2 == 0:
                out["turn"] = vector(stamp, turned(k // 2))
            if k % 5 == 0:
                out["truth"] = vector(stamp, at)
            yield out


def moved(k: int) -> float:
    """A step; each hundredth is a large one."""
    return 10.0 if k % 100 == 50 else 0.01


def turned(k: int) -> float:
    return -1.0 if k % 25 > 12 else 1.0


@dataclass
class Sum:
    value: float = 0.0


class Odometry(Operator):
    """Adds the steps up, each in the direction of the latest turn."""

    step: In[FeatureVector]
    turn: Sampled[FeatureVector]
    at: Out[FeatureVector]
    state: Sum

    def process(self, step: FeatureVector, turn: FeatureVector) -> FeatureVector:
        self.state.value += float(step.vectors[0, 0]) * float(turn.vectors[0, 0])
        return vector(step.stamp, self.state.value)


class Smooth(Operator):
    """Passes it on; stateless."""

    at: In[FeatureVector]
    out: Out[FeatureVector]
    stateless = True

    def process(self, at: FeatureVector) -> FeatureVector:
        return vector(at.stamp, float(at.vectors[0, 0]))


class Score(Operator):
    """How far the estimate is off at its end, and at the most; what it remembers is no declared state."""

    truth: In[FeatureVector]
    at: Sampled[FeatureVector]
    turns: Batch[FeatureVector]

    def setup(self) -> None:
        self._errors: list[float] = []
        self._turns = 0

    def process(self, truth: FeatureVector, at: FeatureVector, turns: Sequence[FeatureVector]) -> None:
        self._errors.append(abs(float(truth.vectors[0, 0]) - float(at.vectors[0, 0])))
        self._turns += len(turns)

    def summary(self) -> Mapping[str, float]:
        return {"end_error_m": self._errors[-1], "worst_error_m": max(self._errors), "turns": self._turns}


TEXT = """
graph: held
record: {{snapshots: 2s}}
operators:
  drive: {{use: 'held_runs:Drive', params: {{steps: {steps}}}}}
  odometry:
    use: held_runs:Odometry
    inputs: {{step: drive/step, turn: drive/turn}}
    live: {{queue: newest, size: 4, wait: 10ms}}
  smooth: {{use: 'held_runs:Smooth', inputs: {{at: odometry/at}}, live: {{queue: newest, size: 4}}}}
  aside: {{use: 'held_runs:Smooth', inputs: {{at: drive/step}}, live: {{queue: newest, size: 4}}}}
  score:
    use: held_runs:Score
    inputs: {{truth: drive/truth, at: smooth/out, turns: drive/turn}}
    live: {{queue: block, wait: 200ms}}
"""


def graph(steps: int = 1000) -> Graph:
    return load_text(TEXT.format(steps=steps))


@dataclass
class Faults:
    """`late`: messages that come late. `still`: operator, from and to which step of 20 ms it stands still."""

    late: Held = field(default_factory=dict)
    still: Sequence[tuple[str, int, int]] = ()


def recorded(graph: Graph, faults: Faults, path: Path) -> Path:
    """Makes and records the run: time goes on by 5 ms, messages arrive, operators that do not stand still work."""
    clock = [0.0]
    driver = Driver()
    emitter = Emitting(driver)
    emitter.recorder = Recorder(path, graph, set(graph.streams), {"metadata": metadata_of(graph, "run"), "overwrite": False})
    for node in graph.nodes.values():
        if not node.source:
            live = LiveRunner(
                node,
                emitter,
                static=graph.static,
                seed=graph.seed,
                snapshots=graph.record.snapshots,
                clock=lambda: clock[0],
                event_clock=lambda: STAMP + round(clock[0] * 1e9),
            )
            driver.add(live)
    driver.set_up()
    arrivals = _arrivals(graph, faults, emitter)
    due = 0
    end = arrivals[-1][0] + 2000 * MS
    for now in range(0, end, 5 * MS):
        clock[0] = now * 1e-9
        while due < len(arrivals) and arrivals[due][0] <= now:
            _, stream, entry = arrivals[due]
            emitter.message(stream, entry)
            due += 1
        still = {name for name, first, last in faults.still if first * 20 * MS <= now < last * 20 * MS}
        for _ in range(50):
            for runner in driver.operators:
                if runner.node.name not in still:
                    runner.step()
    for stream in graph.streams:
        if graph.nodes[graph.streams[stream].node].source:
            emitter.end(stream, None, "end of source")
    for now in range(end, end + 3000 * MS, 50 * MS):
        clock[0] = now * 1e-9
        for runner in driver.operators:
            while runner.step():
                pass
    assert all(runner.ended for runner in driver.operators)
    driver.close()
    emitter.recorder.close("complete")
    return path


def _arrivals(graph: Graph, faults: Faults, emitter: Any) -> list[tuple[int, str, Entry]]:
    """(when, ns; stream; message) of what the source sends, in order of the time of arrival; records its firings."""
    (node,) = graph.sources()
    log = FiringLog(node.name, emitter)
    numbers = dict.fromkeys(node.outputs, 0)
    found: list[tuple[int, str, Entry]] = []
    latest = dict.fromkeys(node.outputs, NEVER)
    log.add("setup", NEVER + 1, 0, outputs=(None,) * len(node.outputs), detail={"params": dict(node.params)})
    for step in node.make().stream():  # type: ignore[attr-defined]
        outputs = []
        for port, stream in node.outputs.items():
            message = step.get(port)
            if message is None:
                outputs.append(None)
                continue
            k = numbers[port]
            numbers[port] += 1
            digest = message.digest()
            outputs.append(Emission(k, message.stamp, digest))
            when = message.stamp - STAMP + faults.late.get((port, k), 0) * MS
            latest[port] = when = max(when, latest[port])  # a stream keeps its order
            found.append((when, stream, Entry(message.stamp, message, k, 0, digest, stream)))
        log.add("fire", message_stamp(step), 0, outputs=tuple(outputs))
    log.add("finish", message_stamp(step), 0, outputs=(None,) * len(node.outputs))
    return sorted(found, key=lambda one: (one[0], one[2].stamp))


def message_stamp(step: Mapping[str, Message]) -> int:
    return next(iter(step.values())).stamp
