"""Finds out whether a captured call gives the same each time, in this process and in new ones, as its test will run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dataflow.capture.captured import CapturedCalls, Outcome, Predicate
from dataflow.execution.failure import place_of

TIMES = 20
"""Times that the calls are made again in each process, at most."""
SECONDS = 2.0
"""After so many seconds they are not begun again."""
HASHES = ("1", "2")
"""Seeds of Python's hashes in the new processes: a test runs with any."""
START = 60.0
"""Seconds in which a new process starts."""


class NotRepeated(RuntimeError):
    """Raised for calls that do not give the same each time, or cannot be made in a new process."""


def check_repeats(captured: CapturedCalls) -> None:
    """Makes the calls again, some times here and in new processes. Raises `NotRepeated` where one result is another."""
    began = time.monotonic()
    here = results(captured)
    if len(set(here)) > 1:
        raise NotRepeated(f"made again {len(here)} times, it gives {len(set(here))} different results")
    limit = START + 5 * max(SECONDS, time.monotonic() - began)
    with tempfile.TemporaryDirectory() as name:
        data = Path(name) / "calls.capture"
        data.write_bytes(captured.to_bytes())
        started = [_start(data, seed) for seed in HASHES]
        try:
            there = [result for process in started for result in _answer(process, limit)]
        finally:
            for process in started:
                process.kill()
                process.communicate()
    if set(there) != set(here):
        raise NotRepeated("made again in a new process, it gives another result")


def results(captured: CapturedCalls) -> list[str]:
    """Makes the calls again; returns what each time shows, in a line: whether the predicate is true, the error and its
    line of code, or the digests of the outputs."""
    began = time.monotonic()
    found = [_result(captured, captured.play())]
    while len(found) < TIMES and time.monotonic() < began + SECONDS:
        found.append(_result(captured, captured.play()))
    return found


def _result(captured: CapturedCalls, outcome: Outcome) -> str:
    if captured.predicate:
        return str(Predicate(captured.predicate).is_true(outcome.names()))
    if outcome.error is not None:
        file, line = place_of(outcome.error.__traceback__)
        return f"{type(outcome.error).__qualname__} {file!r} {line}"
    if captured.expected is None:
        return "no error"
    made = [*outcome.before, outcome.digests]
    return " ".join(f"{port}={each[port].hex()}" for each in made for port in sorted(each))


def _start(data: Path, seed: str) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": seed}
    command = [sys.executable, "-c", "from dataflow.capture.repeats import main; main()", str(data)]
    return subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="backslashreplace",
    )


def _answer(process: subprocess.Popen[str], limit: float) -> list[str]:
    try:
        _, told = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        raise NotRepeated(f"made again in a new process, it takes more than {limit:.0f} s") from None
    if process.returncode:
        last = told.strip().splitlines()[-1:] or [f"exit code {process.returncode}"]
        raise NotRepeated(f"it cannot be made in a new process, as a test would: {last[0]}")
    answer = Path(process.args[-1]).with_suffix(f".{process.pid}")  # type: ignore[index, arg-type]
    return answer.read_text(encoding="utf-8").splitlines()


def main() -> None:
    """Makes the calls of a file again, and writes their results beside it."""
    data = Path(sys.argv[1])
    lines = results(CapturedCalls.from_bytes(data.read_bytes()))
    data.with_suffix(f".{os.getpid()}").write_text("\n".join(lines), encoding="utf-8")
