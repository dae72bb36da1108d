"""Runs a graph in this process, on this thread: the aligners, runners and recorder of a run, without its processes.

Firings depend on timestamps and frontiers alone, so what comes out is what a run in processes gives.
"""

from __future__ import annotations

import functools
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from dataflow.chaos.faults import OperatorFaults
from dataflow.feeds.window import Window
from dataflow.firing.calls import summary_of
from dataflow.firing.failure import OperatorFailure
from dataflow.firing.protocol import Runner
from dataflow.firing.threads import limited_threads
from dataflow.graph.model import Graph, Node
from dataflow.process.config import ProcessConfig
from dataflow.process.feeding import Feeding
from dataflow.process.pace import Pace
from dataflow.process.recorder import RecorderSink
from dataflow.process.runners import Runners, make_log, make_runner, make_source
from dataflow.records.firing import FiringRecord, encode_batch
from dataflow.supervision.plan import LogPlan
from dataflow.supervision.report import OperatorCounts, RunFailed, RunReport, Status
from dataflow.sync import FOREVER, NEVER, Entry

BATCH_RECORDS = 64
SHOW_EVERY = 0.2
Watch = Callable[[Status], None]
Made = TypeVar("Made")


class Recorder:
    """Writes what operators emit, as far as the graph records it, and all firing records."""

    def __init__(self, path: Path, graph: Graph, streams: set[str], options: Mapping[str, Any]) -> None:
        self._streams = {s for s in graph.record.streams if s in streams}
        self._sink = RecorderSink(path, graph, sorted(self._streams), {"compression": "zstd", **options})
        self._records: dict[str, list[FiringRecord]] = {}

    def message(self, stream: str, entry: Entry) -> None:
        if stream in self._streams:
            self._sink.message(stream, entry.value, entry.seq, entry.incarnation)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        if stream in self._streams:
            self._sink.end(stream, final_stamp, reason)

    def record(self, record: FiringRecord) -> None:
        log = self._records.setdefault(record.operator, [])
        log.append(record)
        if len(log) >= BATCH_RECORDS or record.kind == "finish":
            self._flush(record.operator, last=record.kind == "finish")

    def _flush(self, operator: str, *, last: bool = False) -> None:
        log = self._records[operator]
        if log:
            self._sink.firings(operator, log[-1].stamp, encode_batch(log, last=last))
            log.clear()

    def close(self, outcome: str) -> Mapping[str, Any]:
        for operator in self._records:
            self._flush(operator)
        return self._sink.close(outcome)


class Emitting:
    """Hands what an operator emits to those who take it, and to the recorder."""

    def __init__(self, runners: Runners) -> None:
        self._runners = runners
        self.recorder: Recorder | None = None

    def message(self, stream: str, entry: Entry) -> None:
        for runner in self._runners.taking(stream):
            runner.push(stream, entry)
        if self.recorder is not None:
            self.recorder.message(stream, entry)

    def frontier(self, stream: str, frontier: int) -> None:
        for runner in self._runners.taking(stream):
            runner.advance(stream, frontier)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        for runner in self._runners.taking(stream):
            runner.end(stream, final_stamp, reason)
        if self.recorder is not None:
            self.recorder.end(stream, final_stamp, reason)

    def record(self, record: FiringRecord) -> None:
        if self.recorder is not None:
            self.recorder.record(record)


class LocalRun:
    """One execution of a graph in this process. `log`: a recording in place of the sources that made it."""

    def __init__(self, graph: Graph, *, log: LogPlan | None = None, paranoid: bool = False) -> None:
        self.graph, self._log = graph, log
        self._config = config_of(graph, log, paranoid=paranoid)
        self._runners = Runners()
        self._emitter = Emitting(self._runners)
        window = Window(1, 1)
        window.cover(FOREVER)  # one thread: a step is done before the next one is read
        self._feeding = Feeding(window, Pace(None))
        self._stopped = False
        self._first: int | None = None

    def stop(self) -> None:
        """Asks for an orderly end: sources stop, what is under way is finished."""
        self._stopped = True

    def execute(
        self,
        *,
        record: Path | None = None,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        overwrite: bool = False,
        watch: Watch | None = None,
    ) -> RunReport:
        """Runs it to its end, or until Ctrl-C. Raises `RunFailed` with the first operator that fails."""
        replaced = set() if self._log is None else {self.graph.streams[s].node for s in self._log.streams}
        logged = set() if self._log is None else set(self._log.streams)
        made = {s for s, stream in self.graph.streams.items() if stream.node not in replaced} | logged
        if record is not None:
            record.parent.mkdir(parents=True, exist_ok=True)
            options = {"metadata": metadata or {}, "overwrite": overwrite}
            self._emitter.recorder = Recorder(record, self.graph, made, options)
        outcome = "failed: it did not end in order"
        facts: Mapping[str, Any] = {}
        began = time.monotonic()
        try:
            with limited_threads(self.graph.threads), _interrupts(self.stop):
                self._run(replaced, watch)
            outcome = "interrupted" if self._stopped else "complete"
        except OperatorFailure as failure:
            outcome = f"failed: {str(failure).splitlines()[0]}"
            raise RunFailed(str(failure), failure.traceback, failure.operator) from failure
        finally:
            if self._emitter.recorder is not None:
                facts = self._emitter.recorder.close(outcome)
        return self._report(time.monotonic() - began, {} if record is None else {"recorder": facts})

    def _run(self, replaced: set[str], watch: Watch | None) -> None:
        try:
            self._make(replaced)
            for maker in self._runners.all:
                maker.setup()
            for log in self._feeding.logs:
                log.setup()
            self._first = min(self._feeding.first_stamps(), default=None)
            self._work(watch)
        finally:
            self._close()

    def _make(self, replaced: set[str]) -> None:
        for node in self.graph.nodes.values():
            if node.name in replaced:
                continue
            if node.source:
                source = _made(node, functools.partial(make_source, node, self.graph, self._config, self._emitter))
                self._runners.sources.append(source)
                self._feeding.feeds.append(source)
            else:
                make_here(node, self.graph, self._config, self._emitter, self._runners)
        log = make_log(self.graph, self._config, self._emitter)
        if log is not None:
            self._feeding.play_back(log)

    def _work(self, watch: Watch | None) -> None:
        """Runs what is decided, then reads the next step of the feeds, until nothing is left of either."""
        shown = time.monotonic()
        while True:
            if self._stopped:
                self._feeding.finish("interrupted")
            if not (step_each(self._runners) or self._feeding.admit()):
                self._feeding.promise()
                if not step_each(self._runners):
                    break
            if watch is not None and time.monotonic() - shown >= SHOW_EVERY:
                shown = time.monotonic()
                watch(Status(phase="running", operators=self._counts(), first=self._first))
        self._check_ended()

    def _check_ended(self) -> None:
        held = {r.node.name: r.waiting() for r in self._runners.operators if not r.ended}
        if held:
            name, (stamp, needs) = next(iter(held.items()))
            inputs = ", ".join(needs) or "its inputs"
            raise RunFailed(f"operator {name!r} can never fire again: it waits for {inputs} at stamp {stamp}")

    def _close(self) -> None:
        """Closes every operator; the first error is raised when all are closed."""
        failures = self._runners.close(but=())
        for log in self._feeding.logs:
            log.close()
        if failures:
            raise failures[0]

    def _counts(self) -> dict[str, OperatorCounts]:
        counts = {}
        for source in self._runners.sources:
            work = source.work
            counts[source.node.name] = OperatorCounts(
                source.firings, source.ports.emitted, 0, work.cpu_ns, source.last, work.wall_ns
            )
        for runner in self._runners.operators:
            work, dropped = runner.work, sum(runner.drops.values())
            counts[runner.node.name] = OperatorCounts(
                runner.firings, runner.ports.emitted, dropped, work.cpu_ns, runner.done, work.wall_ns
            )
        return counts

    def _report(self, wall: float, files: Mapping[str, Mapping[str, Any]]) -> RunReport:
        counts = self._counts()
        streams: dict[str, tuple[int, str]] = {}
        for maker in self._runners.all:
            for state in maker.ports.states.values():
                assert state.digest is not None
                streams[state.stream] = (state.digest.count, state.digest.hexdigest())
        for log in self._feeding.logs:
            streams |= {name: (count, digest) for name, count, digest in log.counts()}
        reached = [*(log.last for log in self._feeding.logs), *(c.done for c in counts.values())]
        runners = self._runners.operators
        return RunReport(
            graph=self.graph.name,
            streams=dict(sorted(streams.items())),
            operators=counts,
            drops={r.node.name: _losses(r.drops) for r in runners if r.drops},
            summaries={r.node.name: s for r in runners if (s := summary_of(r.operator, r.node.name))},
            transport={},
            files=files,
            first=self._first,
            last=max((stamp for stamp in reached if stamp not in (NEVER, FOREVER)), default=None),
            wall=wall,
            interrupted=self._stopped,
            notes=(),
        )


def _losses(drops: Mapping[tuple[str, str], int]) -> tuple[tuple[str, str, int], ...]:
    return tuple((name, reason, number) for (name, reason), number in sorted(drops.items()))


def config_of(graph: Graph, log: LogPlan | None, *, paranoid: bool) -> ProcessConfig:
    """Returns the configuration that a separate process would get."""
    replay: dict[str, Any] | None = None
    if log is not None:
        span = {"start": log.start, "end": log.end}
        made = {"path": str(log.path), "streams": list(log.streams), "finals": dict(log.finals)}
        replay = {**made, **span, "bag": log.bag}
    return ProcessConfig(
        label="here",
        graph={},
        nodes=list(graph.nodes),
        publish={},
        subscribe=[],
        listen=[],
        replay=replay,
        paranoid=paranoid,
        snapshots=graph.record.snapshots,
        warm=None
        if log is None or log.start is None or log.bag is not None
        else {"path": str(log.path), "stamp": log.start},
    )


def step_each(runners: Runners) -> bool:
    """One step of every operator, last ones first, so that what is under way is done before more is begun."""
    worked = False
    for runner in reversed(runners.operators):
        worked = runner.step() or worked
    return worked


def make_here(node: Node, graph: Graph, config: ProcessConfig, emitter: Emitting, runners: Runners) -> None:
    """Makes the runner of an operator that is not a source. Raises `OperatorFailure`."""
    faults = OperatorFaults()

    def make() -> Runner:
        return make_runner(
            node, graph, config, emitter, faults=faults, event_clock=time.time_ns, on_failure=_cannot_restart
        )

    runners.add(_made(node, make))


def _made(node: Node, make: Callable[[], Made]) -> Made:
    try:
        return make()
    except OperatorFailure:
        raise
    except Exception as error:
        raise OperatorFailure(node.name, "construction", error) from error


def _cannot_restart(failure: OperatorFailure, pause: float) -> None:
    """Restarts belong to live runs, which take processes."""
    raise failure


@contextmanager
def _interrupts(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C, or a notebook's stop button, calls `stop` instead of raising in the middle of an operator; a second one
    raises. Other threads than the main one get none."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)

    def handle(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        stop()

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
