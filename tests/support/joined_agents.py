"""Agents on this machine that play another one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataflow.supervision.core.report import RunReport, Status, Watch

HERE = Path(__file__).resolve().parents[1] / "machines"
"""The folder of the operators that their runs use."""
END_WITHIN = 20.0


@dataclass(frozen=True, slots=True)
class Robot:
    """A machine that has joined: where runs have to listen, the agent's folder, and that of its code."""

    endpoint: str
    folder: Path
    code: Path
    process: subprocess.Popen[str]


def join(name: str, connect: str, folder: Path, *words: str, code: Path = HERE) -> subprocess.Popen[str]:
    """Starts an agent, which finds operators in `code`; it is given relative paths, as users give them."""
    given = [os.path.relpath(word, folder.parent) if os.path.isabs(word) else word for word in words]
    command = [sys.executable, "-m", "dataflow.cli.main", "join", name]
    return subprocess.Popen(
        [*command, "--connect", connect, "--folder", folder.name, *given],
        env={**os.environ, "PYTHONPATH": str(code)},
        cwd=folder.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> str:
    """Ends an agent in order; returns what it said."""
    process.send_signal(signal.SIGTERM)
    return process.communicate(timeout=END_WITHIN)[0]


def taken(report: RunReport) -> dict[str, Any]:
    """Returns the number of messages that each operator took, of those that count them."""
    return {name: summary["taken"] for name, summary in report.summaries.items() if "taken" in summary}


def once_it_runs(act: Callable[[], None]) -> Watch:
    """Returns the watch of a run that begins `act` on a thread once, when the sensor has fired 50 times."""
    begun: list[threading.Thread] = []

    def watch(status: Status) -> None:
        if not begun and status.phase == "running" and status.operators["sensor"].firings > 50:
            begun.append(threading.Thread(target=act, daemon=True))
            begun[0].start()

    return watch


def wait_until(condition: Callable[[], bool], within: float = 60.0) -> None:
    """Waits (bounded) until a condition holds."""
    deadline = time.monotonic() + within
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
