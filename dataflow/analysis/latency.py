"""Path latency: the time from a source's message to the end of the firing that it causes at a sink.

Computed from firing records, so from any recording: every record holds when its call began and how long it took, and
which messages it was given. No operator is imported: what causes a firing follows from the records. An input whose
messages always have the firing's own stamp (within the operator's tolerance), each one given once, *triggers* it; where
an operator has no such input, its batches cause its firings, or, with none of those, what it samples. A sampled input
that always brings a message of the firing's stamp counts as a trigger, rightly: the firing waits for it all the same.
A firing's *critical* cause is the one whose producer finished last. Walking back over critical causes splits a latency
into the operators' own time and the time that messages waited in front of them (transport, queues, and other operators
of the same process).

Clocks: wall time of one machine. Where a run spread over several, their offset is part of the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dataflow.graph.model import Graph, Node
from dataflow.recording import Recording
from dataflow.records.firing import WITHHELD, FiringRecord, decode_batch
from dataflow.sync import InputRef, MessageRef

Place = tuple[str, int, int]
"""A message: stream, incarnation, number."""


@dataclass(frozen=True, slots=True)
class Share:
    """Holds what one operator contributes to a path, on average (ns): its own calls, and the wait in front of them."""

    operator: str
    work: float
    wait: float


@dataclass(frozen=True, slots=True)
class PathLatency:
    """The latency from a source to a sink over the firings of the sink that a message of the source caused (ns).

    `shares` are in path order, averaged over all firings; `costliest` names the operator with the largest sum of work
    and wait.
    """

    source: str
    sink: str
    count: int
    p50: float
    p99: float
    largest: float
    shares: tuple[Share, ...]

    @property
    def costliest(self) -> str:
        return max(self.shares, key=lambda share: share.work + share.wait).operator

    def as_json(self) -> dict[str, Any]:
        return {
            "source": self.source,
            "sink": self.sink,
            "count": self.count,
            "p50_ms": self.p50 * 1e-6,
            "p99_ms": self.p99 * 1e-6,
            "max_ms": self.largest * 1e-6,
            "costliest": self.costliest,
            "shares": [
                {"operator": s.operator, "work_ms": s.work * 1e-6, "wait_ms": s.wait * 1e-6} for s in self.shares
            ],
        }


@dataclass(slots=True)
class _Made:
    """The firing that made a message, as far as latency is concerned. `origin` maps sources to their wall time (ns)."""

    operator: str
    begin: int
    end: int
    cause: _Made | None
    origin: Mapping[str, int]


@dataclass(slots=True)
class _Path:
    latencies: list[int] = field(default_factory=list)
    work: dict[str, int] = field(default_factory=dict)
    wait: dict[str, int] = field(default_factory=dict)


def recorded_latencies(recording: Recording, graph: Graph) -> list[PathLatency]:
    """The latencies of all paths of a recorded run, sources and sinks in graph order. Raises `RecordingError`."""
    return latencies(graph, {name: list(_records(recording, name)) for name in graph.nodes})


def _records(recording: Recording, operator: str) -> Iterator[FiringRecord]:
    for _, payload in recording.firings(operator):
        yield from decode_batch(payload).records


def batch_latencies(graph: Graph, batches: Iterable[bytes]) -> list[PathLatency]:
    """The latencies of all paths, from batches of firing records. Raises `FiringRecordError`."""
    records: dict[str, list[FiringRecord]] = {}
    for batch in batches:
        decoded = decode_batch(batch)
        records.setdefault(decoded.operator, []).extend(decoded.records)
    return latencies(graph, records)


def latencies(graph: Graph, records: Mapping[str, Sequence[FiringRecord]]) -> list[PathLatency]:
    """The latencies of all paths, from the records of each operator in their order.

    A sink is an operator that causes no firing of another one.
    """
    calls = {name: [r for r in records.get(name, ()) if _is_firing(r)] for name in graph.nodes}
    stamps = _stamps(graph, calls)
    causes = {name: _causing_inputs(node, calls[name], stamps) for name, node in graph.nodes.items()}
    made: dict[Place, _Made] = {}
    paths: dict[tuple[str, str], _Path] = {}
    consumed = {stream for name, inputs in causes.items() for i in inputs for stream in graph.nodes[name].inputs[i]}
    for name in _in_order(graph, causes):
        node = graph.nodes[name]
        sink = not node.source and not consumed & set(node.outputs.values())
        for record in calls[name]:
            firing = _firing(node, record, causes[name], made)
            if firing is None:
                continue
            made.update((place, firing) for place, _ in _emitted(node, record))
            if sink:
                for source in firing.origin:
                    _enter(paths.setdefault((source, name), _Path()), firing, source)
    return [_summary(source, sink, path) for (source, sink), path in _sorted(graph, paths)]


def _is_firing(record: FiringRecord) -> bool:
    return record.kind in ("fire", "tick") and record.outcome == "ok"


def _emitted(node: Node, record: FiringRecord) -> Iterator[tuple[Place, int]]:
    """The messages of a firing, each with its stamp."""
    for stream, emission in zip(node.outputs.values(), record.outputs, strict=False):
        if emission is not None and emission.seq != WITHHELD:
            yield (stream, record.incarnation, emission.seq), emission.stamp


def _stamps(graph: Graph, calls: Mapping[str, Sequence[FiringRecord]]) -> dict[Place, int]:
    return {
        place: stamp
        for name, node in graph.nodes.items()
        for record in calls[name]
        for place, stamp in _emitted(node, record)
    }


def _causing_inputs(node: Node, calls: Sequence[FiringRecord], stamps: Mapping[Place, int]) -> tuple[str, ...]:
    """The inputs whose messages cause the firings: triggers, else batches, else all."""
    batches = {name for record in calls for name, ref in record.inputs.items() if isinstance(ref, tuple)}
    single = [name for name in node.inputs if name not in batches]
    triggers = tuple(name for name in single if _triggers(node, name, calls, stamps))
    return triggers or tuple(name for name in node.inputs if name in batches) or tuple(single)


def _triggers(node: Node, name: str, calls: Sequence[FiringRecord], stamps: Mapping[Place, int]) -> bool:
    """Returns whether an input has, in every firing, messages of its stamp that no firing had before."""
    seen: set[Place] = set()
    for record in calls:
        for place in _places(record.inputs.get(name)):
            stamp = stamps.get(place, record.stamp)
            if place in seen or abs(stamp - record.stamp) > node.tolerance:
                return False
            seen.add(place)
    return bool(seen)


def _in_order(graph: Graph, causes: Mapping[str, Sequence[str]]) -> list[str]:
    """Producers before those whose firings they cause; what feeds back into itself stays in graph order."""
    above = {
        name: {graph.streams[s].node for i in inputs for s in graph.nodes[name].inputs[i]}
        for name, inputs in causes.items()
    }
    order: list[str] = []
    left = list(graph.nodes)
    while left:
        free = [name for name in left if not above[name] & set(left) - {name}] or left[:1]
        order += free
        left = [name for name in left if name not in free]
    return order


def _firing(node: Node, record: FiringRecord, inputs: Sequence[str], made: Mapping[Place, _Made]) -> _Made | None:
    """None for a firing whose causes are unknown (they lie before the recording, or were not recorded)."""
    begin, end = record.wall_start, record.wall_start + record.duration
    if node.source:
        return _Made(node.name, begin, end, None, {node.name: begin})
    given = [made[place] for name in inputs for place in _places(record.inputs.get(name)) if place in made]
    if not given:
        return None
    origin: dict[str, int] = {}
    for cause in given:
        for source, at in cause.origin.items():
            origin[source] = max(at, origin.get(source, at))
    return _Made(node.name, begin, end, max(given, key=lambda cause: cause.end), origin)


def _places(ref: InputRef) -> Iterator[Place]:
    """The messages of a reference; of a run of them the last, which is the newest."""
    match ref:
        case None:
            return
        case MessageRef():
            yield ref.stream, ref.incarnation, ref.seq
        case tuple():
            for run in ref:
                yield run.stream, run.incarnation, run.last_seq
        case _:
            for one in ref.values():
                yield one.stream, one.incarnation, one.seq


def _enter(path: _Path, firing: _Made, source: str) -> None:
    path.latencies.append(firing.end - firing.origin[source])
    step: _Made | None = firing
    while step is not None and source in step.origin:
        path.work[step.operator] = path.work.get(step.operator, 0) + step.end - step.begin
        if step.cause is not None:
            path.wait[step.operator] = path.wait.get(step.operator, 0) + max(0, step.begin - step.cause.end)
        step = step.cause


def _summary(source: str, sink: str, path: _Path) -> PathLatency:
    count = len(path.latencies)
    p50, p99 = np.percentile(path.latencies, [50, 99])
    shares = tuple(
        Share(operator, work / count, path.wait.get(operator, 0) / count)
        for operator, work in reversed(path.work.items())
    )
    return PathLatency(source, sink, count, float(p50), float(p99), float(max(path.latencies)), shares)


def _sorted(graph: Graph, paths: Mapping[tuple[str, str], _Path]) -> list[tuple[tuple[str, str], _Path]]:
    place = {name: number for number, name in enumerate(graph.nodes)}
    return sorted(paths.items(), key=lambda item: (place[item[0][0]], place[item[0][1]]))
