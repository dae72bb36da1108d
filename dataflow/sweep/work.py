"""The work on one task: the command in a separate process, and what is kept of its report."""

from __future__ import annotations

import json
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Literal

import xxhash

from dataflow.graph.search import import_path
from dataflow.parent import end_with_parent
from dataflow.sweep.plan import Task

Outcome = Literal["done", "failed", "killed", "timed out", "not fetched"]
TRIES = 2
"""Times that a task is begun whose process was killed from outside."""
LOG_BYTES = 1 << 16
"""Bytes kept of the end of a failed task's output."""
PRINTED, LOG = "printed.json", "log.txt"
FETCH = "import fsspec, sys; store, path = fsspec.core.url_to_fs(sys.argv[1]); store.get_file(path, sys.argv[2])"
"""A program that fetches a file; fsspec is of the extra `ray`."""
WORKER_KILLED = f"was killed by {signal.SIGKILL.name}"
"""Of a worker of `dataflow verify`, as that reports it: for want of memory, as a rule."""
STEP = 0.2
"""Seconds between two looks at whether to stop."""


@dataclass(frozen=True, slots=True)
class Result:
    """The outcome of a task; `rows` hold one mapping for each operator, or a single one without it.

    `code`: the exit code. `wall`: seconds. `log`: the end of what was printed, "" where all went well.
    """

    key: str
    outcome: Outcome
    code: int
    error: str
    rows: tuple[Mapping[str, Any], ...]
    wall: float
    log: str = ""

    @property
    def final(self) -> bool:
        """Returns whether another try would have the same outcome: nothing from outside ended it."""
        return self.outcome in ("done", "failed")


def perform(task: Task, timeout: float, stop: Event | None = None) -> Result:
    """Runs a task's command to its end, within `timeout` seconds; a second time where it was killed.

    `stop`: ends it as soon as this is set.

    Raises only what interrupts this process.
    """
    for _ in range(TRIES):
        result = _once(task, timeout, stop)
        if result.outcome != "killed" or (stop is not None and stop.is_set()):
            break
    return result


def _once(task: Task, timeout: float, stop: Event | None) -> Result:
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="dataflow_sweep_") as name:
        folder = Path(name)
        recording, fetched = _here(task.source.where, folder)
        words = [recording if word is None else word for word in task.words]
        command = [sys.executable, "-m", "dataflow.cli.start", *words]
        code = _run(fetched, folder, timeout, stop) if fetched else 0
        if got := code == 0:
            code = _run(command, folder, timeout - (time.monotonic() - began), stop)
        said = (folder / LOG).read_bytes()[-LOG_BYTES:].decode(errors="replace")
        report = _read(folder / PRINTED)
    outcome: Outcome = (
        "done" if report is not None and (code == 0 or (task.what == "verify" and code == 1)) else "failed"
    )
    last = next((line for line in reversed(said.splitlines()) if line.strip()), f"exit code {code}")
    if code is None:
        outcome, last = "timed out", f"not over within {timeout:g} s"
    elif code < 0:
        outcome, last = "killed", f"killed by {signal.Signals(-code).name}"
    elif not got:
        outcome = "not fetched"
    elif outcome == "failed" and WORKER_KILLED in said:
        outcome = "killed"
    rows = () if report is None else verified(report) if task.what == "verify" else replayed(report)
    if task.what == "evaluate":
        rows = tuple(row for row in rows if row["figures"])
    wall, failed = time.monotonic() - began, outcome != "done"
    log = f"{said}\n{last}".strip() if failed else ""
    return Result(task.key, outcome, -1 if code is None else code, last if failed else "", rows or ({},), wall, log)


def _here(where: str, folder: Path) -> tuple[str, list[str]]:
    """Returns the path of a recording, and the command that fetches it into `folder` if it is elsewhere."""
    if "://" not in where:
        return where, []
    file = str(folder / Path(where).name)
    return file, [sys.executable, "-c", FETCH, where, file]


def _run(command: list[str], folder: Path, timeout: float, stop: Event | None) -> int | None:
    """Returns the exit code, negative for a signal; None after `timeout`, or where it was stopped.

    What it prints is in the files `PRINTED` and `LOG` of `folder`. Nothing that it started outlives this call.
    """
    environment = {**os.environ, "PYTHONPATH": import_path(), "PYTHONUNBUFFERED": "1"}
    with (folder / PRINTED).open("wb") as out, (folder / LOG).open("wb") as err:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env=environment,
            start_new_session=True,
            preexec_fn=end_with_parent,
        )
    handle, ended, deadline = os.pidfd_open(process.pid), False, time.monotonic() + timeout
    try:
        while not ended and (left := deadline - time.monotonic()) > 0 and not (stop is not None and stop.is_set()):
            ended = bool(select.select([handle], [], [], min(left, STEP))[0])
    finally:
        os.close(handle)
        with suppress(ProcessLookupError):  # all of them have ended
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()  # only now: until then no other process has its number
    return code if ended else None


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
