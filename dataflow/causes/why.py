"""Answers why an operator does not make what was recorded of it: re-runs of that operator alone, from its records."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from dataflow.causes.ladder import MOST, Findings, InterventionSearch
from dataflow.causes.rerun import Rerun, RerunSettings, fake_time, run_again
from dataflow.causes.sources import CHANCE, COMPILED, FILE, FOLDER, INPUT, MODULE, SOURCES, kind_of, name_of
from dataflow.causes.traps import Site
from dataflow.graph.model import Graph
from dataflow.graph.reach import with_makers
from dataflow.recording import Recording
from dataflow.records.comparison import Verification
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import graph_that_is_here
from dataflow.supervision.core.report import RunFailed
from dataflow.verification.choice import accountable, env_of
from dataflow.verification.ledger import incomplete_streams
from dataflow.verification.record_totals import GraphRecordTotals
from dataflow.verification.report import VerifyReport
from dataflow.verification.workers.processes import Call, Workers, call_workers

CALLS_AFTER = 32
"""Calls that are repeated after the first that differs."""
FROM_THE_START = 500
"""Calls before the first that differs up to which re-runs begin with the recording, not with a snapshot."""
SECONDS = 60.0
"""Time for the calls of one re-run."""
SITES_SHOWN = 3
Progress = Callable[[str, int, str], None]
"""Is called before each re-run with the operator, the number of the re-run, from 1, and what it tries, in words."""


def _unseen(operator: str, number: int, tried: str) -> None:
    """Shows nothing."""


@dataclass(frozen=True, slots=True)
class Cause:
    """A source on which the results were shown to depend: `source` with its name, if it has one; the lines that led to
    it, most calls first; `calls` of them all."""

    source: str
    sites: tuple[Site, ...] = ()
    calls: int = 0
    left: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        return kind_of(self.source)

    @property
    def what(self) -> str:
        """Returns the source in words."""
        return f"{self.kind} {name_of(self.source) or ', '.join(self.left)}".rstrip()

    @property
    def instead(self) -> str:
        return SOURCES[self.kind].instead

    def as_json(self) -> dict[str, Any]:
        return {"cause": self.kind, "name": name_of(self.source)} | {
            "meaning": SOURCES[self.kind].meaning,
            "sites": [asdict(site) for site in self.sites],
            "calls": self.calls,
            "left": list(self.left),
            "instead": self.instead,
        }


@dataclass(frozen=True, slots=True)
class CauseReport:
    """The answer about one operator. `refused`: the reason for which nothing was tried; `repeats`: whether its re-runs
    agree; `settled`: whether they do with all sources of chance fixed (None where that was not tried or needed).
    `cleared` sources were tried without effect; `reads` are those of chance among them, with the lines. Of each group
    in `open` one has an effect, `left_out` could not be tried, with the reason. `changed` are facts that the recording
    holds and that differ now; `also`: sources that have an effect, and need not differ from those of the recording:
    files and folders that are older than it, and all others where the operator, or a file that it reads, was changed.
    `code_known`: it holds digests of the operator's code. `seconds` in all."""

    operator: str
    refused: str = ""
    repeats: bool | None = None
    settled: bool | None = None
    causes: tuple[Cause, ...] = ()
    cleared: tuple[str, ...] = ()
    reads: tuple[Cause, ...] = ()
    open: tuple[tuple[str, ...], ...] = ()
    left_out: Mapping[str, str] | None = None
    changed: tuple[str, ...] = ()
    also: tuple[Cause, ...] = ()
    code_known: bool = False
    reruns: int = 0
    seconds: float = 0.0

    @property
    def chance(self) -> bool:
        """Returns whether its results differ from run to run, or would but for chance."""
        return self.repeats is False or any(cause.kind in CHANCE for cause in (*self.causes, *self.also))

    def as_json(self) -> dict[str, Any]:
        plain = asdict(replace(self, causes=(), also=(), reads=(), left_out=dict(self.left_out or {})))
        return plain | {name: [each.as_json() for each in getattr(self, name)] for name in ("causes", "also", "reads")}


def why(
    path: Path,
    report: VerifyReport,
    operator: str,
    *,
    graph: Graph | None = None,
    seconds: float = SECONDS,
    stall_timeout: float = 120.0,
    workers: Workers = call_workers,
    progress: Progress = _unseen,
) -> CauseReport:
    """Finds the causes for which an operator does not repeat, by at most `MOST` re-runs of it alone.

    `report`: that of verifying the recording (with `graph`, if it was verified against another). `seconds`: time for
    the calls of one re-run; `stall_timeout`: seconds allowed without progress. `progress` is called for each re-run. An
    operator that cannot be re-run, or that makes what was recorded, is refused, with the reason.
    """
    began = time.monotonic()
    verification = next((v for v in report.operators if v.operator == operator), None)
    if refused := refusal(report, operator, verification):
        return CauseReport(operator, refused=refused)
    assert verification is not None
    bounds = {"seconds": seconds, "stall_timeout": stall_timeout}
    alone = _Alone(path, graph, verification, **bounds, workers=workers, progress=progress)
    changed, known = report.altered(operator), verification.code_known
    revised = bool(report.revised(operator))
    try:
        wrote = alone.lines() if verification.wrote else None
        if verification.first is None:
            made = CauseReport(operator, causes=(_cause(INPUT, wrote),), reruns=1)
        else:
            ladder = InterventionSearch(alone.fire, tuple(alone.left_out), MOST - (wrote is not None))
            made = _answer(ladder.climb(report.repeats(operator)), alone, wrote, verification, revised)
    except RunFailed as failure:
        if failure.interrupted:
            raise
        return CauseReport(operator, refused=f"it cannot be run again: {failure}")
    return replace(made, left_out=alone.left_out, changed=changed, code_known=known, seconds=time.monotonic() - began)


def refusal(report: VerifyReport, operator: str, found: Verification | None) -> str:
    """Returns why there is nothing to find out about an operator; nothing where there is."""
    if operator in report.absent:
        return f"it cannot be run again: {report.absent[operator]}"
    if found is None:
        return "it was not verified: a source or external operator is not run again"
    match report.verdict(found):
        case "culprit":
            return ""
        case "downstream":
            return "its inputs differ: look at the culprits before it"
        case "unverifiable":
            return f"it cannot be run again: {found.missing or 'its records are not whole'}"
    return f"it repeats: {report.verdict(found)}"


def _answer(findings: Findings, alone: _Alone, wrote: Rerun | None, found: Verification, revised: bool) -> CauseReport:
    """Returns the answer from an operator's findings; `revised`: it is not itself as it was recorded."""
    effective = [_cause(source, findings.first, findings.left) for source in findings.causes]
    newer = {
        cause.source
        for cause in effective
        if findings.repeats and cause.kind in (FILE, FOLDER) and alone.is_newer(name_of(cause.source), found)
    }
    as_it_was = not revised and not newer
    causes = [cause for cause in effective if _explains(cause, findings, newer, as_it_was=as_it_was)]
    first = [] if wrote is None else [_cause(INPUT, wrote)]
    reads = [_cause(source, findings.first) for source in findings.cleared if source in CHANCE]
    return CauseReport(
        found.operator,
        repeats=findings.repeats,
        settled=findings.settled,
        causes=(*first, *causes),
        cleared=tuple(findings.cleared),
        reads=tuple(read for read in reads if read.sites),
        open=tuple(findings.open),
        also=tuple(cause for cause in effective if cause not in causes),
        reruns=findings.reruns + len(first),
    )


def _explains(cause: Cause, findings: Findings, newer: Collection[str], *, as_it_was: bool) -> bool:
    """Returns whether a source on which results depend explains why they are not the recorded ones: it makes them
    differ from run to run, it is `newer` than the recording, or all that is known of the operator is as it was."""
    if not findings.repeats or cause.source in newer:
        return True
    return as_it_was and cause.kind not in (FILE, FOLDER)


def _cause(source: str, rerun: Rerun | None, left: tuple[str, ...] = ()) -> Cause:
    sites = [] if rerun is None else [(site, count) for of, site, count in rerun.sites if of == source]
    sites.sort(key=lambda one: -one[1])
    shown = tuple(site for site, _ in sites[:SITES_SHOWN])
    return Cause(source, shown, sum(count for _, count in sites), left if source == MODULE else ())


class _Alone:
    """Re-runs one operator, beside those that make what it takes and the recording does not hold."""

    def __init__(
        self,
        path: Path,
        graph: Graph | None,
        found: Verification,
        *,
        seconds: float,
        stall_timeout: float,
        workers: Workers,
        progress: Progress,
    ) -> None:
        name = self._operator = found.operator
        self._workers, self._stall_timeout = workers, stall_timeout
        self._progress, self._fired = progress, 0
        with Recording(path) as recording:
            played = graph or graph_that_is_here(recording)[0]
            log = FiringLog.read(recording)
            books = GraphRecordTotals(log, played)
            told = [each for each in played.nodes if accountable(recording, played, books, each)]
            incomplete = incomplete_streams(recording, played, books, told)
            held = recording.streams.keys() - incomplete
            chosen = with_makers(held, played, {name})
            last = max((record.wall_start for record in log.ordered(played.nodes[name])), default=0) * 1e-9
        self.recorded = min(path.stat().st_mtime, last or math.inf)
        self._operators = tuple(each for each in played.nodes if each in chosen)
        self._env, self._threads = env_of(played, self._operators, held), played.threads
        at = 0 if found.first is None else found.first.index
        far = found.first is not None and at > FROM_THE_START
        self._request = {
            "path": str(path),
            "graph": played.to_json(),
            "records": log.to_wire(),
            "operators": list(self._operators),
            "operator": name,
            "modules": sorted({played.nodes[name].use.partition(":")[0]}),
            "incomplete": sorted(incomplete),
            "begin": found.first.stamp - 1 if far and found.first is not None else None,
            "most": CALLS_AFTER if far else at + CALLS_AFTER,
            "seconds": seconds,
            "began": time.time_ns(),
        }
        self.left_out: dict[str, str] = {}
        if not fake_time():
            self.left_out[COMPILED] = "libfaketime is not installed (pip install libfaketime)"

    def fire(self, setting: RerunSettings) -> Rerun:
        """Re-runs the operator in a new process. Raises `RunFailed`."""
        self._fired += 1
        self._progress(self._operator, self._fired, setting.words)
        call = Call(
            f"{run_again.__module__}:{run_again.__name__}",
            {**self._request, "setting": setting.to_wire()},
            self._operators,
            setting.environment(),
            self._env,
        )
        [answer] = self._workers([call], threads=self._threads, stall_timeout=self._stall_timeout)
        return Rerun.from_wire(answer)

    def lines(self) -> Rerun:
        """Re-runs the operator to find the lines that write into its inputs."""
        return self.fire(RerunSettings(lines=True))

    def is_newer(self, file: str, found: Verification) -> bool:
        """Returns whether a file or folder was changed or put here after the operator's last call, or is not the
        recorded one. Copies keep the time of the last change, and not that at which they were put here."""
        if file in found.files_changed:
            return True
        if not os.path.exists(file):
            return False
        status = os.stat(file)
        return max(status.st_mtime, status.st_ctime) > self.recorded


def reasons(
    path: Path, report: VerifyReport, operators: Sequence[str], graph: Graph | None = None, progress: Progress = _unseen
) -> list[CauseReport]:
    """Returns the answer for each of `operators`, or for the culprits where none are named."""
    return [why(path, report, name, graph=graph, progress=progress) for name in operators or report.culprits]
