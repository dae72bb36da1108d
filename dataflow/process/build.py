"""Makes what a process runs: its operators, its sources, and the recording that stands in for sources."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dataflow.execution.driver import Driver, Maker
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.feeds.log import LogFeed, gapless
from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.execution.live import LiveRunner
from dataflow.execution.ports import Emitter
from dataflow.execution.runner import OperatorRunner
from dataflow.execution.source import SourceRunner
from dataflow.graph.model import Graph, Node
from dataflow.graph.reach import with_makers
from dataflow.process.config import ProcessConfig, ResumeState
from dataflow.process.live_sources import LiveSources
from dataflow.recording import Recording
from dataflow.records.black_box import BlackBox, OperatorProgress
from dataflow.records.spacing import StateSpacing
from dataflow.remote import Remote

Outlived = Callable[[OperatorFailure, float], None]
"""Is told of a failure that an operator outlives, and in how many seconds it is made anew."""


def _cannot_restart(failure: OperatorFailure, pause: float) -> None:
    raise failure


def build(
    driver: Driver,
    graph: Graph,
    config: ProcessConfig,
    emitter: Emitter,
    *,
    live: LiveSources | None = None,
    event_clock: Callable[[], int] | None = None,
    on_failure: Outlived = _cannot_restart,
) -> None:
    """Makes the operators that `config` names, and the recording that is replayed, if any. Sources go among the feeds
    of the driver, those of a live run to `live`. Raises `OperatorFailure` for an operator that cannot be made."""
    for name in config.nodes:
        node = graph.nodes[name]
        try:
            if node.source:
                _make_source(driver, node, graph, config, emitter, live)
            else:
                driver.add(_make_runner(node, graph, config, emitter, event_clock, on_failure))
        except OperatorFailure:
            raise
        except Exception as error:
            raise OperatorFailure(name, "construction", error) from error
    if config.replay is not None:
        driver.feeding.play_back(_log(graph, config.replay, emitter))


def _make_source(
    driver: Driver, node: Node, graph: Graph, config: ProcessConfig, emitter: Emitter, live: LiveSources | None
) -> None:
    """Makes a source; it goes on where the process before this one died."""
    source = SourceRunner(node, emitter, seed=graph.seed, live=config.live)
    _resume(source, config.resumed(node.name))
    if isinstance(source.source, Remote) and not config.live:
        raise ValueError("messages from outside come by the clock, which only a live run has: run it with --live")
    driver.sources.append(source)
    if live is not None and config.live:
        live.add(source)
    else:
        driver.feeding.feeds.append(source)


def _make_runner(
    node: Node,
    graph: Graph,
    config: ProcessConfig,
    emitter: Emitter,
    event_clock: Callable[[], int] | None,
    on_failure: Outlived,
) -> OperatorRunner:
    """Makes the runner of an operator that has inputs."""
    recorded = graph.record
    repeated = len(with_makers(recorded.streams, graph, [node.name]))
    common: dict[str, Any] = {
        "static": graph.static,
        "seed": graph.seed,
        "paranoid": config.paranoid,
        "snapshots": None if recorded.snapshots is None else StateSpacing(recorded.snapshots, repeated),
    }
    if config.live:
        live = LiveRunner(node, emitter, **common, event_clock=event_clock, on_failure=on_failure)
        _resume(live, config.resumed(node.name))
        return live
    runner = OperatorRunner(node, emitter, **common)
    if config.warm is not None:
        _begin_in_the_middle(runner, graph, Path(config.warm["path"]), config.warm["stamp"])
    return runner


def _log(graph: Graph, replay: dict[str, Any], emitter: Emitter) -> LogFeed:
    """Opens the recording that stands in for sources."""
    makers = {stream: graph.streams[stream].node for stream in replay["streams"]}
    recording, start, end = _played(Path(replay["path"]), replay["bag"]), replay["start"], replay["end"]
    return LogFeed(
        recording,
        makers,
        emitter,
        ports={name: tuple(graph.nodes[name].outputs.values()) for name in set(makers.values())},
        finals=replay["finals"],
        start=start,
        end=end,
        messages=gapless(recording.messages(list(makers), start, end)),
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
        name: OperatorProgress(
            r.incarnation - 1, dict(r.last), dict(r.changed), {k: (p[0], p[1]) for k, p in r.places.items()}
        )
        for name, r in before.items()
        if r.incarnation
    }
    return BlackBox(descriptor, ports, reached)


def _resume(runner: Maker, resumed: ResumeState) -> None:
    if resumed.incarnation:
        runner.resume(resumed.incarnation, resumed.last, resumed.changed)


def _begin_in_the_middle(runner: OperatorRunner, graph: Graph, path: Path, stamp: int) -> None:
    from dataflow.reexecution.warm_start import held_before, warm_start

    held, began = held_before(path, runner.node, stamp, graph.static)
    if began:
        runner.aligner.begin_at(stamp)
    warm = warm_start(path, graph, runner.node, stamp)
    if warm is not None:
        runner.take_over(warm.operator, stamp)
    for entry in held:
        runner.aligner.push(entry.stream, entry)
