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

import heapq
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from dataflow.graph.model import Graph, Node
from dataflow.recording import Recording
from dataflow.records.firing import WITHHELD, FiringRecord, decode_batch
from dataflow.records.reading import FiringLog
from dataflow.sync import InputRef, MessageRef

T = TypeVar("T")
KEPT = 16_384
"""Messages of a stream that are kept while not all of its consumers have taken one, and firings between two looks at
which may go."""
NEVER = (2**63, 0)
AHEAD = 60 * 10**9
"""Event time (ns) by which the firing that made a message may lie behind that which takes it, beside the tolerance."""
FEW = 1024
"""So few messages of a stream are kept without a look."""
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
    latencies: array[int] = field(default_factory=lambda: array("q"))
    work: dict[str, int] = field(default_factory=dict)
    wait: dict[str, int] = field(default_factory=dict)


def records_of(recording: Recording, graph: Graph) -> dict[str, Iterable[FiringRecord]]:
    """Returns the records of each operator, in order, read whenever they are iterated over. Raises `RecordingError`."""
    log = FiringLog.read(recording)
    return {name: _Recorded(log, node) for name, node in graph.nodes.items()}


@dataclass(frozen=True, slots=True)
class _Recorded:
    """The records of one operator in order, read whenever they are iterated over."""

    log: FiringLog
    node: Node

    def __iter__(self) -> Iterator[FiringRecord]:
        return self.log.ordered(self.node)


def batch_latencies(graph: Graph, batches: Iterable[bytes]) -> list[PathLatency]:
    """The latencies of all paths, from batches of firing records. Raises `FiringRecordError`."""
    records: dict[str, list[FiringRecord]] = {}
    for batch in batches:
        decoded = decode_batch(batch)
        records.setdefault(decoded.operator, []).extend(decoded.records)
    return latencies(graph, records)


def latencies(graph: Graph, records: Mapping[str, Iterable[FiringRecord]]) -> list[PathLatency]:
    """The latencies of all paths, from the records of each operator in their order, which are iterated over twice.

    A sink is an operator that causes no firing of another one. In memory are the latencies, 8 bytes each, and of each
    stream the messages that may still be taken: those from the last one on that each consumer took, but at most
    `KEPT`, which is more than any queue holds.
    """
    causes = _causes(graph, records)
    ranks = {name: rank for rank, name in enumerate(_in_order(graph, causes))}
    paths: dict[tuple[str, str], _Path] = {}
    consumed = {stream for name, inputs in causes.items() for i in inputs for stream in graph.nodes[name].inputs[i]}
    sinks = {n for n, node in graph.nodes.items() if not node.source and not consumed & set(node.outputs.values())}

    def made_by(node: Node, record: FiringRecord, made: Window[_Made]) -> _Made | None:
        places = (place for port in causes[node.name] for place in _places(record.inputs.get(port)))
        known = [firing for place in places if (firing := made.get(place)) is not None]
        firing = _firing(node, record, [cause for cause in known if ranks[cause.operator] <= ranks[node.name]])
        if firing is not None and node.name in sinks:
            for source in firing.origin:
                _enter(paths.setdefault((source, node.name), _Path()), firing, source)
        return firing

    _Walk(graph, records, causes, made_by).run()
    return [_summary(source, sink, path) for (source, sink), path in _sorted(graph, paths)]


class Window(Generic[T]):
    """Holds what is known of the messages that may still be taken, by stream."""

    def __init__(self, streams: Iterable[str]) -> None:
        self._known: dict[str, dict[tuple[int, int], T]] = {stream: {} for stream in streams}

    def get(self, place: Place) -> T | None:
        """Returns what is known of a message; None where its firing is not known."""
        return self._known.get(place[0], {}).get(place[1:])

    def put(self, place: Place, value: T) -> None:
        """Notes a message that was sent."""
        self._known[place[0]][place[1:]] = value

    def __getitem__(self, stream: str) -> Mapping[tuple[int, int], T]:
        return self._known[stream]

    def forget(self, stream: str, taken: Sequence[tuple[int, int] | None]) -> None:
        """Drops messages before the last ones that the consumers of a stream took, None: none so far."""
        known = self._known[stream]
        floors = [place for place in taken if place is not None]
        kept = set(floors) | set(list(known)[-KEPT:])
        least = min(floors, default=NEVER) if len(floors) == len(taken) else None
        self._known[stream] = {
            place: value for place, value in known.items() if place in kept and (least is None or place >= least)
        }


class _Walk(Generic[T]):
    """Goes through the firings of all operators at once, by stamp, producers before those whose firings they cause.

    `make`: returns what is known of a firing, from what is known of the messages before it; None: not known.
    """

    def __init__(
        self,
        graph: Graph,
        records: Mapping[str, Iterable[FiringRecord]],
        causes: Mapping[str, Sequence[str]],
        make: Callable[[Node, FiringRecord, Window[T]], T | None],
    ) -> None:
        self._graph, self._causes, self._make = graph, causes, make
        self._makers = {name: stream.node for name, stream in graph.streams.items()}
        self._ranks = {name: rank for rank, name in enumerate(_in_order(graph, causes))}
        self._left = {name: filter(_is_firing, records.get(name, ())) for name in graph.nodes}
        self._heads = {name: next(left, None) for name, left in self._left.items()}
        self._window = Window[T](graph.streams)
        self._taken: dict[str, dict[tuple[str, str], tuple[int, int] | None]] = {stream: {} for stream in graph.streams}
        """By stream, for each input of a consumer the last message that it took."""
        for name, node in graph.nodes.items():
            for port in causes[name]:
                for stream in node.inputs[port]:
                    self._taken[stream][name, port] = None
        self._busy: set[str] = set()
        self._steps = 0

    def run(self) -> None:
        """Goes through all of them."""
        ahead = [(head.stamp, self._ranks[name], name) for name, head in self._heads.items() if head is not None]
        heapq.heapify(ahead)
        while ahead:
            _, rank, name = heapq.heappop(ahead)
            if self._heads[name] is None:
                continue
            self._step(name)
            head = self._heads[name]
            if head is not None:
                heapq.heappush(ahead, (head.stamp, rank, name))
            if self._steps >= KEPT:
                self._steps = 0
                self._forget()

    def _step(self, name: str) -> None:
        """Takes the next firing of an operator, behind those that made what it took."""
        record, node = self._heads[name], self._graph.nodes[name]
        assert record is not None
        self._steps += 1
        self._busy.add(name)
        for port in self._causes[name]:
            for place in _places(record.inputs.get(port)):
                self._reach(place, record.stamp + node.tolerance + AHEAD)
                if (name, port) in self._taken.get(place[0], ()):
                    self._taken[place[0]][name, port] = place[1:]
        made = self._make(node, record, self._window)
        if made is not None:
            for place, _ in _emitted(node, record):
                self._window.put(place, made)
        self._busy.discard(name)
        self._heads[name] = next(self._left[name], None)

    def _reach(self, place: Place, latest: int) -> None:
        """Goes on with the maker of a message up to there, or up to the stamp `latest`."""
        maker = self._makers.get(place[0], "")
        while self._window.get(place) is None and maker not in self._busy:
            head = self._heads.get(maker)
            if head is None or head.stamp > latest:
                return
            if any(at > place for at, _ in _emitted(self._graph.nodes[maker], head) if at[0] == place[0]):
                return
            self._step(maker)

    def _forget(self) -> None:
        for stream, taken in self._taken.items():
            if len(self._window[stream]) > FEW:
                self._window.forget(
                    stream, [place for (name, _), place in taken.items() if self._heads[name] is not None]
                )


def _is_firing(record: FiringRecord) -> bool:
    return record.kind in ("fire", "tick") and record.outcome == "ok"


def _emitted(node: Node, record: FiringRecord) -> Iterator[tuple[Place, int]]:
    """The messages of a firing, each with its stamp."""
    for stream, emission in zip(node.outputs.values(), record.outputs, strict=False):
        if emission is not None and emission.seq != WITHHELD:
            yield (stream, record.incarnation, emission.seq), emission.stamp


def _causes(graph: Graph, records: Mapping[str, Iterable[FiringRecord]]) -> dict[str, tuple[str, ...]]:
    """The inputs whose messages cause the firings of each operator: triggers, else batches, else all."""
    triggers = {name: dict.fromkeys(node.inputs, True) for name, node in graph.nodes.items()}
    last: dict[tuple[str, str, str], tuple[int, int]] = {}
    batches: set[tuple[str, str]] = set()

    def look(node: Node, record: FiringRecord, stamps: Window[Mapping[Place, int]]) -> Mapping[Place, int]:
        """An input triggers if it has, in every firing, messages of its stamp that no firing had before."""
        for port, ref in record.inputs.items():
            if isinstance(ref, tuple):
                batches.add((node.name, port))
            for stream, *at in _places(ref):
                place = at[0], at[1]
                known = stamps.get((stream, *place))
                stamp = record.stamp if known is None else known[stream, *place]
                before = last.get((node.name, port, stream))
                if (before is not None and place <= before) or abs(stamp - record.stamp) > node.tolerance:
                    triggers[node.name][port] = False
                last[node.name, port, stream] = place
        return dict(_emitted(node, record))

    _Walk(graph, records, {name: tuple(node.inputs) for name, node in graph.nodes.items()}, look).run()
    taken = {(name, port) for name, port, _ in last}
    found: dict[str, tuple[str, ...]] = {}
    for name, node in graph.nodes.items():
        single = [port for port in node.inputs if (name, port) not in batches]
        trigger = tuple(port for port in single if triggers[name][port] and (name, port) in taken)
        found[name] = trigger or tuple(port for port in node.inputs if (name, port) in batches) or tuple(single)
    return found


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


def _firing(node: Node, record: FiringRecord, given: Sequence[_Made]) -> _Made | None:
    """None for a firing whose causes are unknown (they lie before the recording, or were not recorded)."""
    begin, end = record.wall_start, record.wall_start + record.duration
    if node.source:
        return _Made(node.name, begin, end, None, {node.name: begin})
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
    p50, p99 = np.percentile(np.asarray(path.latencies), [50, 99])
    shares = tuple(
        Share(operator, work / count, path.wait.get(operator, 0) / count)
        for operator, work in reversed(path.work.items())
    )
    return PathLatency(source, sink, count, float(p50), float(p99), float(max(path.latencies)), shares)


def _sorted(graph: Graph, paths: Mapping[tuple[str, str], _Path]) -> list[tuple[tuple[str, str], _Path]]:
    place = {name: number for number, name in enumerate(graph.nodes)}
    return sorted(paths.items(), key=lambda item: (place[item[0][0]], place[item[0][1]]))
