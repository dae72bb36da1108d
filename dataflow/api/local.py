"""Runs a graph in this process, on this thread: the aligners, runners and recorder of a run, without its processes.

Firings depend on timestamps and frontiers alone, so what comes out is what a run in processes gives.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from dataflow.execution.driver import Driver, LocalEmitter
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.threads import limited_threads
from dataflow.graph.model import Graph
from dataflow.process.build import build
from dataflow.process.config import ProcessConfig
from dataflow.process.progress import counts_of, final_report
from dataflow.records.firing import FiringRecord, encode_batch
from dataflow.sinks.recorder import RecorderSink
from dataflow.supervision.configs import replay_of, warm_start_of
from dataflow.supervision.core.report import OperatorCounts, RunFailed, RunReport, Status
from dataflow.supervision.plan import LogPlan, replaced_in
from dataflow.sync import FOREVER, NEVER, Entry

BATCH_RECORDS = 64
SHOW_EVERY = 0.2
Watch = Callable[[Status], None]


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


class Emitting(LocalEmitter):
    """Gives what operators emit to the recorder, too."""

    recorder: Recorder | None = None

    def message(self, stream: str, entry: Entry) -> None:
        super().message(stream, entry)
        if self.recorder is not None:
            self.recorder.message(stream, entry)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        super().end(stream, final_stamp, reason)
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
        self._driver = Driver()
        self._emitter = Emitting(self._driver)
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
        logged = set() if self._log is None else set(self._log.streams)
        made = {s for s, stream in self.graph.streams.items() if stream.node in self._config.nodes} | logged
        if record is not None:
            record.parent.mkdir(parents=True, exist_ok=True)
            options = {"metadata": metadata or {}, "overwrite": overwrite}
            self._emitter.recorder = Recorder(record, self.graph, made, options)
        outcome = "failed: it did not end in order"
        facts: Mapping[str, Any] = {}
        began = time.monotonic()
        try:
            with limited_threads(self.graph.threads), _interrupts(self.stop):
                self._run(watch)
            outcome = "interrupted" if self._stopped else "complete"
        except OperatorFailure as failure:
            outcome = f"failed: {str(failure).splitlines()[0]}"
            raise RunFailed(str(failure), failure.traceback, failure.operator) from failure
        finally:
            if self._emitter.recorder is not None:
                facts = self._emitter.recorder.close(outcome)
        return self._report(time.monotonic() - began, {} if record is None else {"recorder": facts})

    def _run(self, watch: Watch | None) -> None:
        try:
            build(self._driver, self.graph, self._config, self._emitter)
            self._driver.set_up()
            self._first = min(self._driver.feeding.first_stamps(), default=None)
            self._work(watch)
        finally:
            if failures := self._driver.close():
                raise failures[0]

    def _work(self, watch: Watch | None) -> None:
        shown = time.monotonic()
        while self._driver.turn():
            if self._stopped:
                self._driver.feeding.finish("interrupted")
            if watch is not None and time.monotonic() - shown >= SHOW_EVERY:
                shown = time.monotonic()
                watch(Status(phase="running", operators=self._counts(), first=self._first))
        self._check_ended()

    def _check_ended(self) -> None:
        held = {r.node.name: r.waiting() for r in self._driver.operators if not r.ended}
        if held:
            name, (stamp, needs) = next(iter(held.items()))
            inputs = ", ".join(needs) or "its inputs"
            raise RunFailed(f"operator {name!r} can never fire again: it waits for {inputs} at stamp {stamp}")

    def _counts(self) -> dict[str, OperatorCounts]:
        rows = counts_of(self._driver, self._driver.operators)
        return {name: OperatorCounts(*row) for name, row in rows.items() if name in self.graph.nodes}

    def _report(self, wall: float, files: Mapping[str, Mapping[str, Any]]) -> RunReport:
        found = final_report(self._driver, {})
        reached = [row[4] for row in found["counts"].values()]
        return RunReport(
            graph=self.graph.name,
            streams={name: (count, digest) for name, (count, digest) in sorted(found["streams"].items())},
            operators=self._counts(),
            drops=_rows(found["drops"]),
            summaries=found["summaries"],
            transport={},
            files=files,
            first=self._first,
            last=max((stamp for stamp in reached if stamp not in (NEVER, FOREVER)), default=None),
            wall=wall,
            interrupted=self._stopped,
            notes=(),
            waits=_rows(found["waits"]),
            namespace=self.graph.namespace,
        )


def _rows(found: Mapping[str, Sequence[Sequence[Any]]]) -> dict[str, tuple[tuple[str, str, int], ...]]:
    return {name: tuple((port, what, n) for port, what, n in rows) for name, rows in found.items() if rows}


def config_of(graph: Graph, log: LogPlan | None, *, paranoid: bool = False, sources: bool = True) -> ProcessConfig:
    """Returns the configuration that a separate process would get. Sources that the recording replaces are left out,
    and without `sources` all of them."""
    replaced = set() if sources else {node.name for node in graph.sources()}
    if log is not None:
        replaced = replaced_in(graph, log)
    return ProcessConfig(
        label="here",
        graph={},
        nodes=[name for name in graph.nodes if name not in replaced],
        publish={},
        subscribe=[],
        listen=[],
        replay=replay_of(log),
        paranoid=paranoid,
        warm=warm_start_of(log),
    )


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
