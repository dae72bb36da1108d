"""Live runs on a clock that is turned by hand: messages come late, operators stand still, all of it recorded."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.api.local import Emitting, Recorder
from dataflow.api.runs import metadata_of
from dataflow.execution.driver import Driver
from dataflow.execution.live import LiveRunner
from dataflow.execution.log import FiringLog
from dataflow.graph import Graph, load_text
from dataflow.graph.model import Node
from dataflow.messages import FeatureVector, Message
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source
from dataflow.recording import Recording
from dataflow.records.firing import Emission, FiringRecord
from dataflow.records.spacing import StateSpacing
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


class Beat(Operator, every="100ms"):
    """Counts the estimates that its beats see."""

    at: Sampled[FeatureVector]

    def setup(self) -> None:
        self._beats = 0

    def process(self, at: FeatureVector) -> None:
        self._beats += 1

    def summary(self) -> Mapping[str, int]:
        return {"beats": self._beats}


class Count(Operator):
    """Adds up; its state is declared."""

    step: In[FeatureVector]
    out: Out[FeatureVector]
    state: Sum

    def process(self, step: FeatureVector) -> FeatureVector:
        self.state.value += float(step.vectors[0, 0])
        return vector(step.stamp, self.state.value)


class Brittle(Smooth):
    """Raises at one message."""

    def process(self, at: FeatureVector) -> FeatureVector:
        if at.stamp == STAMP + 2000 * MS:
            raise ValueError("not this one")
        return super().process(at)


class HalfSmooth(Smooth):
    """Another version, which gives something else."""

    def process(self, at: FeatureVector) -> FeatureVector:
        return vector(at.stamp, float(at.vectors[0, 0]) / 2.0)


class Chancy(Score):
    """Its figure is another each time."""

    def summary(self) -> Mapping[str, float]:
        return {**super().summary(), "end_error_m": 10.0 + time.perf_counter()}


class Undecided(Score):
    """An error of middle size is not a number."""

    def summary(self) -> Mapping[str, float]:
        figures = dict(super().summary())
        return figures | ({"end_error_m": float("nan")} if 1 < figures["end_error_m"] < 25 else {})


class Silent(Score):
    """An error of middle size is left out."""

    def summary(self) -> Mapping[str, float]:
        figures = super().summary()
        return {} if 1 < figures["end_error_m"] < 25 else figures


class Scaled(Operator):
    """A value times a parameter that may change; stateless."""

    at: In[FeatureVector]
    out: Out[FeatureVector]
    gain: float = Param(1.0, doc="factor", tunable=True)
    stateless = True

    def process(self, at: FeatureVector) -> FeatureVector:
        return vector(at.stamp, float(at.vectors[0, 0]) * self.gain)


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
  beat: {{use: 'held_runs:Beat', inputs: {{at: drive/step}}, live: {{queue: newest, size: 2, wait: 100ms}}}}
  score:
    use: held_runs:{score}
    inputs: {{truth: drive/truth, at: smooth/out, turns: drive/turn}}
    live: {{queue: block, wait: 200ms}}
"""


def graph(steps: int = 1000, score: str = "Score") -> Graph:
    return load_text(TEXT.format(steps=steps, score=score))


@dataclass
class Faults:
    """`late`: messages that come late. `still`: operator, from and to which step of 20 ms it stands still."""

    late: Held = field(default_factory=dict)
    still: Sequence[tuple[str, int, int]] = ()


class RestartRecorder(Recorder):
    """Records operators that are started again, too: a batch is of one incarnation."""

    def record(self, record: FiringRecord) -> None:
        held = self._records.get(record.operator)
        if held and held[-1].incarnation != record.incarnation:
            self._flush(record.operator)
        super().record(record)


def recorded(graph: Graph, faults: Faults, path: Path, played: Recording | None = None) -> Path:
    """Makes and records the run: time goes on by 5 ms, messages arrive, operators that do not stand still work.

    `played`: a recording of the source's messages.
    """
    clock = [0.0]
    driver = Driver()
    emitter = Emitting(driver)
    emitter.recorder = RestartRecorder(
        path, graph, set(graph.streams), {"metadata": metadata_of(graph, "run"), "overwrite": False}
    )
    for node in graph.nodes.values():
        if not node.source:
            live = LiveRunner(
                node,
                emitter,
                static=graph.static,
                seed=graph.seed,
                snapshots=None if (apart := graph.record.snapshots) is None else StateSpacing(apart),
                clock=lambda: clock[0],
                event_clock=lambda: STAMP + round(clock[0] * 1e9),
            )
            driver.add(live)
    driver.set_up()
    arrivals = _arrivals(graph, faults, emitter, played)
    due = 0
    end = arrivals[-1][0] + 10 * MS
    for now in range(0, end, 5 * MS):
        clock[0] = now * 1e-9
        while due < len(arrivals) and arrivals[due][0] <= now:
            _, stream, entry = arrivals[due]
            emitter.message(stream, entry)
            due += 1
        still = {name for name, first, last in faults.still if first * 20 * MS <= now < last * 20 * MS}
        working = [runner for runner in driver.operators if runner.node.name not in still]
        while sum(runner.step() for runner in working):
            pass
    for stream, made in graph.streams.items():
        if graph.nodes[made.node].source and not made.static:
            emitter.end(stream, None, "end of source")
    for now in range(end, end + 1000 * MS, 50 * MS):
        clock[0] = now * 1e-9
        for runner in driver.operators:
            while runner.step():
                pass
    assert all(runner.ended for runner in driver.operators)
    driver.close()
    emitter.recorder.close("complete")
    return path


def _arrivals(graph: Graph, faults: Faults, emitter: Any, played: Recording | None) -> list[tuple[int, str, Entry]]:
    """(when, ns; stream; message) of what the source sends, in order of the time of arrival; records its firings."""
    (node,) = graph.sources()
    log = FiringLog(node.name, emitter)
    numbers = dict.fromkeys(node.outputs, 0)
    found: list[tuple[int, str, Entry]] = []
    latest = dict.fromkeys(node.outputs, NEVER)
    last = STAMP
    static, steps = ({}, node.make().stream()) if played is None else _played(played, node)  # type: ignore[attr-defined]
    outputs = [_sent(static.get(port), stream, 0) for port, stream in node.outputs.items()]
    log.add("setup", NEVER + 1, 0, outputs=_emissions(outputs), detail={"params": dict(node.params)})
    for entry in filter(None, outputs):
        emitter.message(entry.stream, entry)
        emitter.end(entry.stream, None, "static")
    for step in steps:
        outputs = [_sent(step.get(port), stream, numbers[port]) for port, stream in node.outputs.items()]
        for port, sent in zip(node.outputs, outputs, strict=True):
            if sent is not None:
                when = sent.stamp - STAMP + faults.late.get((port, numbers[port]), 0) * MS
                latest[port] = when = max(when, latest[port])  # a stream keeps its order
                found.append((when, sent.stream, sent))
                numbers[port] += 1
                last = sent.stamp
        log.add("fire", last, 0, outputs=_emissions(outputs))
    log.add("finish", last, 0, outputs=(None,) * len(node.outputs))
    return sorted(found, key=lambda one: (one[0], one[2].stamp))


def _sent(message: Message | None, stream: str, number: int) -> Entry | None:
    return None if message is None else Entry(message.stamp, message, number, 0, message.digest(), stream)


def _emissions(sent: Sequence[Entry | None]) -> tuple[Emission | None, ...]:
    return tuple(None if entry is None else Emission(entry.seq, entry.stamp, entry.digest) for entry in sent)


def _played(recording: Recording, node: Node) -> tuple[dict[str, Message], Iterator[Mapping[str, Message]]]:
    """What a source gave in a recording: its static messages by port, and its steps, from the stamp `STAMP` on."""
    ports = {stream: port for port, stream in node.outputs.items() if stream in recording.streams}
    there = list(recording.messages(list(ports)))
    static = {ports[item.stream]: item.message for item in there if recording.streams[item.stream].static}
    moving = [item for item in there if not recording.streams[item.stream].static]
    ahead = STAMP - min(item.message.stamp for item in moving)
    steps = itertools.groupby(moving, key=lambda item: item.message.stamp)
    return static, (
        {ports[item.stream]: item.message.replace(stamp=stamp + ahead) for item in items} for stamp, items in steps
    )
