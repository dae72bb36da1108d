"""The work on one task: the command in a separate process, and what is kept of its report."""

from __future__ import annotations

import json
import math
import signal
import tempfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Literal, cast

import xxhash

from dataflow.recording.mcap.index import NO_END
from dataflow.sweep.plan import Task, file_name
from dataflow.sweep.warm import Worker

Outcome = Literal["done", "failed", "killed", "timed out", "not fetched"]
ERROR = "error: "
"""Begins the line of a command with the reason of its failure; a traceback may follow."""
TRIES = 2
"""Times that a task is begun whose process was killed from outside."""
LOG_BYTES = 1 << 16
"""Bytes kept of the end of a failed task's output."""
EMPTY = "it holds no message for this graph"
"""Of a recording of which nothing was replayed: its figures are of nothing."""
PRINTED, LOG = "printed.json", "log.txt"
WORKER_KILLED = f"was killed by {signal.SIGKILL.name}"
"""Of a worker of `dataflow verify`, as that reports it: for want of memory, as a rule."""


@dataclass(frozen=True, slots=True)
class Result:
    """The outcome of a task; `rows` hold one mapping for each operator, or a single one without it.

    `code`: the exit code. `wall`: seconds. `log`: the end of what was printed, "" where all went well. `torn`: the
    recording has no proper end, so the rows are of its stored part.
    """

    key: str
    outcome: Outcome
    code: int
    error: str
    rows: tuple[Mapping[str, Any], ...]
    wall: float
    log: str = ""
    torn: bool = False

    @property
    def final(self) -> bool:
        """Returns whether another try would have the same outcome: nothing from outside ended it."""
        return self.outcome in ("done", "failed")


def commands_of(tasks: Iterable[Task]) -> tuple[str, ...]:
    """Returns the commands that tasks call."""
    return tuple(sorted({word for task in tasks if (word := task.words[0]) is not None}))


def perform(task: Task, timeout: float, worker: Worker, stop: Event | None = None) -> Result:
    """Runs a task's command to its end, within `timeout` seconds; a second time where it was killed.

    `stop`: ends it as soon as this is set.

    Raises only what interrupts this process.
    """
    for _ in range(TRIES):
        result = _once(task, timeout, worker, stop)
        if result.outcome != "killed" or (stop is not None and stop.is_set()):
            break
    return result


def _once(task: Task, timeout: float, worker: Worker, stop: Event | None) -> Result:
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="dataflow_sweep_") as name:
        output = Path(name, PRINTED), Path(name, LOG)
        where, code = task.source.where, cast("int | None", 0)
        if "://" in where:
            where = str(Path(name, file_name(where)))
            code = worker.call("fetch", [task.source.where, where], (), output, timeout, stop)
        if got := code == 0:
            words = [where if word is None else word for word in task.words]
            left = timeout - (time.monotonic() - began)
            code = worker.call("command", words, task.operators, output, left, stop)
        printed = output[1].read_bytes()
        said, torn = printed[-LOG_BYTES:].decode(errors="replace"), NO_END.encode() in printed
        report = _read(output[0])
    outcome: Outcome = (
        "done" if report is not None and (code == 0 or (task.what == "verify" and code == 1)) else "failed"
    )
    lines = [line for line in said.splitlines() if line.strip()] or [f"exit code {code}"]
    last = next((line.removeprefix(ERROR) for line in lines if line.startswith(ERROR)), lines[-1])
    if code is None:
        outcome, last = "timed out", f"not over within {timeout:g} s"
    elif code < 0:
        outcome, last = "killed", f"killed by {signal.Signals(-code).name}"
    elif not got:
        outcome = "not fetched"
    elif outcome == "failed" and WORKER_KILLED in said:
        outcome = "killed"
    elif outcome == "done" and task.what != "verify" and report is not None and report["first_stamp"] is None:
        outcome, last, report = "failed", EMPTY + (f", and {NO_END}" if torn else ""), None
    rows = () if report is None else verified(report) if task.what == "verify" else replayed(report)
    if task.what == "evaluate":
        rows = tuple(row for row in rows if row["figures"])
        if outcome == "done" and not rows:
            outcome, last = "failed", "no operator of the graph gives figures"
    wall, failed = time.monotonic() - began, outcome != "done"
    log = f"{said}\n{last}".strip() if failed else ""
    return Result(
        task.key, outcome, -1 if code is None else code, last if failed else "", rows or ({},), wall, log, torn
    )


def _read(printed: Path) -> dict[str, Any] | None:
    try:
        value = json.loads(printed.read_bytes())
    except ValueError:  # the command failed before it had a report
        return None
    return value if isinstance(value, dict) and "operators" in value else None


def replayed(report: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """Returns a row for each operator of a run's report, as `dataflow replay --json` prints it."""
    digests: dict[str, list[str]] = {}
    for stream, facts in sorted(report["streams"].items()):
        digests.setdefault(stream.rpartition("/")[0], []).append(f"{stream}={facts['digest']}")
    rows = []
    for name, counts in report["operators"].items():
        own = digests.get(f"{report['namespace']}/{name}", [])
        rows.append(
            {
                "operator": name,
                **{key: counts[key] for key in ("firings", "emitted", "dropped", "cpu_ms", "wall_ms")},
                "restarts": report["restarts"].get(name, 0),
                "digest": xxhash.xxh3_128_hexdigest("\n".join(own).encode()) if own else None,
                "figures": numbers(report["summaries"].get(name, {})),
            }
        )
    more = {name for name in report["summaries"] if name not in report["operators"]}
    rows += [{"operator": name, "figures": numbers(report["summaries"][name])} for name in sorted(more)]
    return tuple(rows)


def numbers(summary: Mapping[str, Any]) -> dict[str, float]:
    """Returns the figures of a summary that are numbers, also where JSON has words for them."""
    named = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
    values = {name: named.get(v, v) if isinstance(v, str) else v for name, v in summary.items()}
    return {name: float(v) for name, v in values.items() if isinstance(v, int | float) and not isinstance(v, bool)}


def verified(report: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """Returns a row for each operator of a verification, as `dataflow verify --json` prints it."""
    return tuple(
        {
            "operator": row["operator"],
            "verdict": row["verdict"],
            **{key: row[key] for key in ("firings", "differing") if key in row},
        }
        for row in [*report["operators"], *report["sources"]]
    )
