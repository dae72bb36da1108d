"""Runs, replays and verifications of graphs, for programs and notebooks."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from dataflow.api.graphs import GraphLike, resolved
from dataflow.api.html import run_html, verify_html
from dataflow.api.local import LocalRun, Watch
from dataflow.api.recordings import RecordedStreams, open
from dataflow.arguments import checked, evaluated, require
from dataflow.editing.unmapped_topics import keep_untouched
from dataflow.execution.generators import seeding
from dataflow.graph import Graph as ResolvedGraph
from dataflow.graph.problems import did_you_mean
from dataflow.interop.clocks import Choice
from dataflow.interop.opening import is_foreign
from dataflow.recording import Recording
from dataflow.recording.layout import BAG, RUN
from dataflow.recording.notices import warning
from dataflow.recording.streams.facts import machine_facts
from dataflow.reexecution.recorded_run import graph_metadata, recorded_graph
from dataflow.supervision import plan
from dataflow.supervision.core.report import RunReport
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.replay import plan_replay
from dataflow.supervision.sim_to_real import warn_of_gap
from dataflow.verification.report import VerifyReport

NOTEBOOK = "__main__:"
"""The beginning of import paths of operators in a notebook or script: no other process finds them."""
_SET_BY_LAUNCH = ("graph", "log", "record", "live", "overwrite", "faults")


@dataclass(frozen=True, slots=True)
class RunResult:
    """The result of a run: its report, and the recording if there is one."""

    report: RunReport
    path: Path | None = None

    @property
    def summaries(self) -> Mapping[str, Mapping[str, Any]]:
        """The figures of metrics sinks, by operator: {figure: value}."""
        return self.report.summaries

    @property
    def drops(self) -> Mapping[str, tuple[tuple[str, str, int], ...]]:
        """By operator, (input, reason, number) of the messages that reached no firing."""
        return self.report.drops

    def digests(self) -> dict[str, str]:
        """The digest of each stream: equal for equal runs."""
        return self.report.digests()

    def open(self) -> RecordedStreams:
        """Opens the recording. Raises `ValueError` when none was made."""
        if self.path is None:
            raise ValueError("this run was not recorded: run(record='FILE.mcap')")
        return open(self.path)

    def __repr__(self) -> str:
        made = sum(count for count, _ in self.report.streams.values())
        recorded = f", recorded in {self.path}" if self.path is not None else ""
        return f"<run of {self.report.graph}: {made:,} messages in {self.report.wall:.2f} s{recorded}>"

    def _repr_html_(self) -> str:
        return run_html(self.report)


@dataclass(frozen=True, slots=True)
class Verified:
    """The result of a verification; `report` has all of it."""

    report: VerifyReport

    @property
    def identical(self) -> bool:
        """True when every recorded firing was repeated with the same outputs, bit for bit."""
        return self.report.identical

    @property
    def culprits(self) -> tuple[str, ...]:
        """The operators whose own results differ."""
        return self.report.culprits

    def __repr__(self) -> str:
        found = "identical" if self.identical else f"not identical; culprits: {', '.join(self.culprits) or 'none'}"
        return f"<verification: {found}, {self.report.messages:,} messages>"

    def _repr_html_(self) -> str:
        return verify_html(self.report)


@checked
def run(
    graph: GraphLike,
    *,
    record: str | Path | None = None,
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    paranoid: bool = False,
    watch: Watch | None = None,
) -> RunResult:
    """Runs a graph in this process, on this thread, as fast as it goes, and returns when it is done.

    `graph`: a `Graph`, or the path of a YAML file; then `settings` are what `--set` takes: {"detector.threshold": 0.3}.
    The streams are those of a run in processes, message digest by message digest, given the same thread settings of
    numpy's libraries. `paranoid` catches operators that write into their inputs. Ctrl-C ends it in order. Raises
    `GraphError`, and `RunFailed` with the operator that failed.
    """
    built = resolved(graph, settings)
    warn_of_gap(built)
    file = None if record is None else Path(record)
    report = LocalRun(built, paranoid=paranoid).execute(
        record=file, metadata=metadata_of(built, "run"), overwrite=overwrite, watch=watch
    )
    return RunResult(report, file)


@checked
def replay(
    recording: str | Path,
    *,
    graph: GraphLike | None = None,
    start: float | None = None,
    end: float | None = None,
    record: str | Path | None = None,
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    paranoid: bool = False,
    maps: Mapping[str, str] | None = None,
    clock: Choice = "auto",
    watch: Watch | None = None,
) -> RunResult:
    """Replays a recording in this process, through the graph that made it or another one with the same sources.

    Recorded streams replace the sources; everything else runs again. `start`, `end`: seconds from the first message;
    operators begin in the state that they had at `start`. A ROS bag (file or folder) or any MCAP plays into `graph`
    too, and its other topics are in the recording as they are: `maps` assigns topics to streams
    (`{"/camera/image_raw": "camera/image"}`), where types leave a choice; `clock` whether headers or log times stamp
    it. Raises `ReplayError`, `GraphError`, `RunFailed`, and `MappingError` that lists the topics.
    """
    with warning():
        return _replayed(Path(recording), graph, start, end, record, overwrite, settings, paranoid, maps, clock, watch)


def _replayed(
    path: Path,
    graph: GraphLike | None,
    start: float | None,
    end: float | None,
    record: str | Path | None,
    overwrite: bool,
    settings: Mapping[str, Any] | None,
    paranoid: bool,
    maps: Mapping[str, str] | None,
    clock: Choice,
    watch: Watch | None,
) -> RunResult:
    facts: dict[str, dict[str, str]] = {}
    played: set[str] | None = None
    shift = 0
    if graph is not None and is_foreign(path):
        from dataflow.interop.playing import play  # bags need libraries that no recording does

        built = resolved(graph, settings)
        words = [f"{topic}={stream}" for topic, stream in (maps or {}).items()]
        with play(path, built, words, clock) as bag:
            log = plan_replay(bag, built, start=start, end=end)
            warn_of_gap(built, bag)
            facts, played = {BAG: bag.facts()}, {p.topic for p in bag.played.values()}
            shift = bag.clock.shift
    else:
        with Recording(path) as opened:
            built = recorded_graph(opened) if graph is None else resolved(graph, settings)
            log = plan_replay(opened, built, start=start, end=end)
            warn_of_gap(built, opened)
    file = None if record is None else Path(record)
    report = LocalRun(built, log=log, paranoid=paranoid).execute(
        record=file, metadata=facts | metadata_of(built, "replay"), overwrite=overwrite, watch=watch
    )
    if file is not None and played is not None:
        keep_untouched(file, path, played, log.start, log.end, shift=shift)
    return RunResult(report, file)


@checked
def launch(
    graph: GraphLike,
    *,
    live: bool = False,
    record: str | Path | None = None,
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    watch: Watch | None = None,
    **options: Any,
) -> RunResult:
    """Runs a graph in separate processes, as `dataflow run` does, and returns when it is done.

    `live`: sources run by the clock. Further options are the fields of `RunPlan`: `placement`, `rate`, `view_file`.
    Raises `GraphError`, `RunFailed`, and `ValueError` for operators of a notebook, which other processes cannot find.
    """
    from dataflow.supervision.run import run as run_in_processes

    chosen = _plan_options(options)
    built = resolved(graph, settings)
    if here := _defined_here(built):
        raise ValueError(f"{', '.join(here)}: defined in this program, where no other process finds them; use run()")
    file = None if record is None else Path(record)
    report = run_in_processes(built, watch=watch, live=live, record=file, overwrite=overwrite, **chosen)
    return RunResult(report, file)


@checked
def verify(
    recording: str | Path,
    *,
    graph: GraphLike | None = None,
    tolerance: float | None = None,
    start: float | None = None,
    first: str | None = None,
    only: str | Sequence[str] | None = None,
    jobs: int | None = None,
) -> Verified:
    """Re-executes a recording by its firing records and compares every output with what was recorded.

    `tolerance`: absolute, for floating-point fields; `start`: seconds from the first message; `first`: an operator, to
    verify it and what follows from it; `only`: one operator or several, to verify those alone; `jobs`: worker
    processes. Operators of a notebook are re-executed in this process. Raises `ReplayError`,
    `RunFailed`.
    """
    from dataflow.api.in_process import call_here
    from dataflow.verification.verify import verify as verify_recording
    from dataflow.verification.workers.processes import call_workers

    path = Path(recording)
    with Recording(path) as opened:
        built = recorded_graph(opened) if graph is None else resolved(graph)
    workers = call_here if _defined_here(built) else call_workers
    chosen = [only] if isinstance(only, str) else only
    report = verify_recording(
        path, graph=built, tolerance=tolerance, start=start, first=first, only=chosen, jobs=jobs, workers=workers
    )
    return Verified(report)


def _plan_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """The further options of `launch`, held to the fields of `RunPlan`. Raises `TypeError`."""
    able = {f.name: f.type for f in fields(RunPlan) if f.name not in _SET_BY_LAUNCH}
    hints = evaluated(able, vars(plan))
    for name in options:
        if name not in able:
            raise TypeError(f"launch(): no option {name!r}: {did_you_mean(name, able, 'there are')}")
    made = {n: Path(v) if isinstance(v, str) and n in ("view_file", "flight") else v for n, v in options.items()}
    require("launch", ((name, value, hints[name]) for name, value in made.items()))
    return made


def _defined_here(graph: ResolvedGraph) -> list[str]:
    return [node.name for node in graph.nodes.values() if node.use.startswith(NOTEBOOK)]


def metadata_of(graph: ResolvedGraph, mode: str) -> dict[str, dict[str, str]]:
    """Returns the metadata of a recording made here; the thread settings are those of this process."""
    facts = {
        "mode": mode,
        "started": str(time.time_ns()),
        "rate": "as fast as it goes",
        "seed": str(graph.seed),
        seeding.FACT: str(seeding.VERSION),
        "threads": str(graph.threads),
    }
    return {**graph_metadata(graph), RUN: facts, **machine_facts(dict(os.environ))}
