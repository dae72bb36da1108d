"""Re-executes recorded operators by their firing records, in this process, fed from the recording.

Verification, the completion of thin recordings and replays that begin in the middle all run operators through
`Recomputation`; they differ in what they do with the messages.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

from dataflow.execution.driver import Driver, LocalEmitter
from dataflow.execution.feeds.log import LogFeed
from dataflow.execution.memory import MemoryGuard
from dataflow.execution.recorded import RecordedRunner, Watcher
from dataflow.execution.threads import limit_threads
from dataflow.graph.model import Graph, Node
from dataflow.recording import Recording
from dataflow.records.comparison import Verification
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.records.repetition import Repetition, look_at
from dataflow.reexecution.in_turn import RunnerInTurn, Turns
from dataflow.reexecution.needed import first_needed, needed_messages
from dataflow.reexecution.recorded_run import NotRecorded, check_type, final_stamps, seeding_of
from dataflow.sync import Entry

Take = Callable[[str, Entry], None]
"""Is given every message of a stream, in stream order."""
End = Callable[[str, int | None, str], None]
"""Is told of the end of every stream: its final stamp and the reason."""


_NOTHING: Mapping[str, tuple[int | None, int | None]] = {}


class ReexecutionStalled(RuntimeError):
    """No recorded firing can be made, and nothing is left to read: a fault of the records or of the engine."""


@dataclass(frozen=True, slots=True)
class Feeding:
    """Holds what is re-executed and what is read: operators in graph order, the recorded streams that feed them, and
    those that are read besides and feed no operator."""

    operators: tuple[str, ...]
    streams: tuple[str, ...]
    besides: tuple[str, ...] = ()

    def reading(self, streams: Collection[str]) -> Feeding:
        """The same, with `streams` read too."""
        return replace(self, besides=tuple(sorted(set(streams).difference(self.streams))))


def plan_feeding(
    recording: Recording, graph: Graph, operators: Collection[str], *, incomplete: Collection[str] = ()
) -> Feeding:
    """Feeds operators from the recording wherever it holds what they take; else what makes it runs too.

    `incomplete` streams are recorded, but lack messages that the recorded firings were given: they are made again.
    Raises `NotRecorded` when a stream of a source or an external operator is needed and was not recorded.
    """
    chosen, streams = set(operators), set[str]()
    left = list(operators)
    while left:
        node = graph.nodes[left.pop()]
        for stream in node.taken:
            maker = graph.nodes[graph.streams[stream].node]
            if stream in recording.streams and stream not in incomplete:
                check_type(recording, graph, stream)
                streams.add(stream)
            elif maker.source or maker.external:
                raise NotRecorded(
                    f"{recording.path}: stream {stream!r} was not recorded, but {node.name!r} takes it and "
                    f"{maker.name!r} cannot make it again",
                    stream,
                )
            elif maker.name not in chosen:
                chosen.add(maker.name)
                left.append(maker.name)
    return Feeding(tuple(name for name in graph.nodes if name in chosen), tuple(sorted(streams)))


class Recomputation:
    """Recorded operators, driven by their records on one thread.

    Re-execution begins at the stamp `begin` (see `dataflow.records.repetition`) and ends before the firings from `end`
    on; `slices` are operators of which only the calls between two stamps are repeated (see `verification.slices`).
    `guard` watches over the memory of what they are given; `make_effects`: see `RecordedJournal`. `in_turn`: operators
    whose calls are made in the order of the run (`RunnerInTurn`).
    `made` is given every message that the operators make, `read` every message that is read for them; `ended` the
    ends of the streams that are made.
    """

    def __init__(
        self,
        recording: Recording,
        graph: Graph,
        feeding: Feeding,
        log: FiringLog,
        *,
        made: Take,
        read: Take | None = None,
        ended: End | None = None,
        begin: int | None = None,
        end: int | None = None,
        slices: Mapping[str, tuple[int | None, int | None]] = _NOTHING,
        guard: MemoryGuard | None = None,
        watcher: Watcher | None = None,
        make_effects: bool = False,
        in_turn: Collection[str] = (),
    ) -> None:
        self._driver = Driver(in_order=True)  # writers into a message come before readers whose digests show it
        nodes = [graph.nodes[name] for name in feeding.operators]
        records = {n.name: partial(_until, partial(log.ordered, n), slices.get(n.name, (None, end))[1]) for n in nodes}
        outlet = _HandOver(self._driver, frozenset(feeding.streams), made, ended)
        begins = {} if begin is None else _begins(graph, records, frozenset(feeding.streams), begin)
        begins |= {name: first for name, (first, _) in slices.items() if first is not None}
        repeated = _repetitions(nodes, records, begins)
        taken = {stream for node in nodes for stream in node.taken}
        inputs = log.digests([graph.nodes[name] for name in {graph.streams[s].node for s in taken}], taken)
        made_as = dict.fromkeys(in_turn, partial(RunnerInTurn, turns=Turns()))
        self.runners = {
            node.name: made_as.get(node.name, RecordedRunner)(
                node,
                outlet,
                static=graph.static,
                repetition=repeated[node.name],
                inputs=inputs,
                seed=graph.seed,
                seeding=seeding_of(recording),
                guard=guard,
                watcher=watcher,
                make_effects=make_effects,
            )
            for node in nodes
        }
        for runner in self.runners.values():
            self._driver.add(runner)
        makers = {stream: graph.streams[stream].node for stream in sorted({*feeding.streams, *feeding.besides})}
        starts = None if begin is None else first_needed(log, graph, self.runners.values())
        self._feed = LogFeed(
            recording,
            makers,
            _HandOver(self._driver, frozenset(feeding.besides), read, None),
            ports={name: tuple(graph.nodes[name].outputs.values()) for name in set(makers.values())},
            finals=final_stamps(recording, makers),
            end=end,
            messages=None if starts is None else needed_messages(recording, makers, starts, begin, end),
        )
        self._driver.feeding.feeds.append(self._feed)
        self._threads = graph.threads
        self.wall = 0.0
        """Seconds that `run` took from when all operators were set up."""

    def run(self, *, until: Callable[[], bool] = lambda: False, close: bool = True) -> Mapping[str, Verification]:
        """Makes the recorded firings, to the end or until `until()`, asked now and then; then closes. Raises
        `OperatorFailure`, `RecordingError`, `ReexecutionStalled`."""
        try:
            self.begin()
            began = time.monotonic()
            left = self.turn()
            while left and not until():
                left = self.turn()
            self.wall = time.monotonic() - began
            if left:
                return self.results()
        finally:
            if close:
                self.close()
        if waiting := [r.node.name for r in self.runners.values() if not r.ended]:
            raise ReexecutionStalled(
                f"everything is read and {', '.join(waiting)} still wait: {self.runners[waiting[0]].waiting()}"
            )
        return self.results()

    def begin(self) -> None:
        """Sets the operators up. Raises `OperatorFailure`, `RecordingError`."""
        limit_threads(self._threads)
        self._driver.set_up()
        self._feed.setup()

    def turn(self) -> bool:
        """Has every operator make at most one call. False where nothing is left to do. Raises as `run`."""
        return self._driver.turn()

    def close(self, *, besides: str = "") -> None:
        """Closes all operators but the one named."""
        self._driver.close(but=(besides,))

    @property
    def reading_cpu_ns(self) -> int:
        """CPU time that reading the recording took so far."""
        return self._feed.work.cpu_ns

    def results(self) -> Mapping[str, Verification]:
        """The outcome for each operator so far."""
        return {name: runner.result for name, runner in self.runners.items()}


def _repetitions(
    nodes: Iterable[Node], records: Mapping[str, Callable[[], Iterable[FiringRecord]]], begins: Mapping[str, int]
) -> Mapping[str, Repetition]:
    """Reads, side by side, what is repeated of each operator's records."""
    found = {
        n.name: Repetition(records[n.name], begin=begins.get(n.name), stateless=n.operator.stateless) for n in nodes
    }
    look_at(found.values())
    return found


def _begins(
    graph: Graph, records: Mapping[str, Callable[[], Iterable[FiringRecord]]], fed: frozenset[str], begin: int
) -> dict[str, int]:
    """From which stamp on each operator is to be repeated: `begin`, or before what those need that take its messages,
    where the recording does not hold them."""
    begins = dict.fromkeys(records, begin)
    moved = list(records)
    while moved:
        node = graph.nodes[moved.pop()]
        repeated = Repetition(records[node.name], begin=begins[node.name], stateless=node.operator.stateless)
        look_at([repeated])
        for stream, place in repeated.needed.items():
            maker = graph.streams[stream].node
            if stream in fed or maker not in begins:
                continue
            made = _stamp_of(records[maker](), list(graph.nodes[maker].outputs.values()).index(stream), place)
            if made is not None and made <= begins[maker]:
                begins[maker] = made - 1
                moved.append(maker)
    return begins


def _stamp_of(records: Iterable[FiringRecord], port: int, place: tuple[int, int]) -> int | None:
    """The stamp of the call that emitted a message; None for `setup`, which is always repeated."""
    for record in records:
        emission = record.outputs[port] if record.outputs else None
        if emission is not None and (record.incarnation, emission.seq) == place:
            return record.stamp if record.kind in CALLS else None
    return None


def _until(records: Callable[[], Iterable[FiringRecord]], end: int | None) -> Iterator[FiringRecord]:
    """The records before the first call at or after the stamp `end`."""
    for record in records():
        if end is not None and record.kind in CALLS and record.stamp >= end:
            return
        yield record


class _HandOver(LocalEmitter):
    """Gives messages to `take`, too, and to no operator where those that take the stream are fed from `elsewhere`."""

    def __init__(self, driver: Driver, elsewhere: frozenset[str], take: Take | None, ended: End | None) -> None:
        super().__init__(driver)
        self._elsewhere, self._take, self._ended = elsewhere, take, ended

    def message(self, stream: str, entry: Entry) -> None:
        if self._take is not None:
            self._take(stream, entry)
        if stream not in self._elsewhere:
            super().message(stream, entry)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        if self._ended is not None:
            self._ended(stream, final_stamp, reason)
        if stream not in self._elsewhere:
            super().end(stream, final_stamp, reason)
