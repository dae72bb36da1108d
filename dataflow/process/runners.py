"""Makes the runners of a process: which kind drives an operator follows from what the supervisor has said."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from pathlib import Path
from typing import Any

from dataflow.chaos.faults import OperatorFaults
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.feeds.log import LogFeed
from dataflow.execution.feeds.numbering import gapless
from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.execution.live import LiveRunner
from dataflow.execution.ports import Emitter
from dataflow.execution.protocol import Runner
from dataflow.execution.ready import Ready
from dataflow.execution.runner import OperatorRunner
from dataflow.execution.source import SourceRunner
from dataflow.graph.model import Graph, Node
from dataflow.process.config import ProcessConfig, Resumed
from dataflow.recording import Recording
from dataflow.records.black_box import BlackBox, Reached
from dataflow.sync import NEVER, Entry
from dataflow.transport import Envelope, Kind

Maker = SourceRunner | Runner
"""Drives an operator that emits."""


class Runners:
    """The runners of one process, and which of them take a stream."""

    def __init__(self) -> None:
        self.sources: list[SourceRunner] = []
        self.operators: list[Runner] = []
        self.ready = Ready()
        """Those of them that have something to do."""
        self.consumers: dict[str, list[Runner]] = {}
        self.faults: dict[str, OperatorFaults] = {}
        """Faults made on purpose in the operators of a live run."""

    @property
    def all(self) -> list[Maker]:
        """Everything that emits, sources first."""
        return [*self.sources, *self.operators]

    def __getitem__(self, name: str) -> Maker:
        return next(maker for maker in self.all if maker.node.name == name)

    def add(self, runner: Runner) -> None:
        self.operators.append(runner)
        self.ready.add(runner)
        for stream in {s for streams in runner.node.inputs.values() for s in streams}:
            self.consumers.setdefault(stream, []).append(runner)

    def close(self, *, but: Container[str]) -> list[OperatorFailure]:
        """Closes every operator but those named; returns what went wrong."""
        failures = []
        for maker in self.all:
            if maker.node.name in but:
                continue
            try:
                maker.close()
            except OperatorFailure as failure:
                failures.append(failure)
            except Exception as error:
                failures.append(OperatorFailure(maker.node.name, "close()", error))
        return failures

    def taking(self, stream: str) -> Iterable[Runner]:
        return self.consumers.get(stream, ())


def give(runner: Runner, stream: str, envelope: Envelope) -> None:
    """Gives a runner another process's message or frontier on a stream. Raises `StreamOrderError` for one that
    contradicts earlier ones."""
    message = envelope.message
    if message is not None:
        runner.push(stream, Entry(envelope.stamp, message, envelope.seq, envelope.incarnation, b"", stream))
    elif envelope.kind is Kind.FRONTIER:
        runner.advance(stream, envelope.stamp)
    elif envelope.kind is Kind.END:
        runner.end(stream, None if envelope.stamp == NEVER else envelope.stamp, envelope.reason)


def make_source(node: Node, graph: Graph, config: ProcessConfig, emitter: Emitter) -> SourceRunner:
    """The runner of a source; it goes on where the process before this one died."""
    source = SourceRunner(node, emitter, seed=graph.seed, live=config.live)
    _resume(source, config.resumed(node.name))
    return source


def make_runner(
    node: Node,
    graph: Graph,
    config: ProcessConfig,
    emitter: Emitter,
    *,
    faults: OperatorFaults,
    event_clock: Callable[[], int],
    on_failure: Callable[[OperatorFailure, float], None],
) -> Runner:
    """Makes the runner of an operator that has inputs."""
    common: dict[str, Any] = {
        "static": statics_of(graph),
        "seed": graph.seed,
        "paranoid": config.paranoid,
        "snapshots": config.snapshots,
    }
    if config.live:
        live = LiveRunner(node, emitter, **common, event_clock=event_clock, on_failure=on_failure, fault=faults.before)
        _resume(live, config.resumed(node.name))
        return live
    runner = OperatorRunner(node, emitter, **common)
    if config.warm is not None:
        _begin_in_the_middle(runner, graph, Path(config.warm["path"]), config.warm["stamp"])
    return runner


def make_log(graph: Graph, config: ProcessConfig, emitter: Emitter) -> LogFeed | None:
    """The recording that stands in for sources, if there is one."""
    replay = config.replay
    if replay is None:
        return None
    nodes = {graph.streams[s].node for s in replay["streams"]}
    return LogFeed(
        _played(Path(replay["path"]), replay["bag"]),
        {s: graph.streams[s].node for s in replay["streams"]},
        emitter,
        ports={n: tuple(graph.nodes[n].outputs.values()) for n in nodes},
        finals=replay["finals"],
        start=replay["start"],
        end=replay["end"],
        numbered=gapless,
    )


def _played(path: Path, bag: dict[str, Any] | None) -> PlayableStreams:
    if bag is None:
        return Recording(path)
    from dataflow.interop.streams import recorded_streams  # bags need libraries that no other run does

    return recorded_streams(path, bag)


def open_box(descriptor: int, config: ProcessConfig, graph: Graph) -> BlackBox:
    """Opens what keeps the firing records of this process; they go on from where the one before it had got to."""
    ports = {name: tuple(graph.nodes[name].outputs) for name in config.nodes}
    before = {name: config.resumed(name) for name in config.nodes}
    reached = {
        name: Reached(r.incarnation - 1, dict(r.last), dict(r.changed), {k: (p[0], p[1]) for k, p in r.places.items()})
        for name, r in before.items()
        if r.incarnation
    }
    return BlackBox(descriptor, ports, reached)


def statics_of(graph: Graph) -> frozenset[str]:
    """The static streams of a graph."""
    return frozenset(name for name, stream in graph.streams.items() if stream.static)


def _resume(runner: Maker, resumed: Resumed) -> None:
    if resumed.incarnation:
        runner.resume(resumed.incarnation, resumed.last, resumed.changed)


def _begin_in_the_middle(runner: OperatorRunner, graph: Graph, path: Path, stamp: int) -> None:
    from dataflow.reexecution.warm_start import held_before, warm_start

    held, began = held_before(path, runner.node, stamp, statics_of(graph))
    if began:
        runner.aligner.begin_at(stamp)
    warm = warm_start(path, graph, runner.node, stamp)
    if warm is not None:
        runner.take_over(warm.operator, stamp)
    for entry in held:
        runner.aligner.push(entry.stream, entry)
