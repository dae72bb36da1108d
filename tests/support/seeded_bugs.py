"""Records the bugs of `zoo.bugs`, captures them, and runs the tests that come out."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from zoo import bugs

import dataflow
from dataflow.capture.capture import CaptureResult, capture, write_test
from dataflow.debugging.debugger import Debugger
from dataflow.graph import Graph, load_text
from dataflow.recording import Recording
from dataflow.supervision.core.report import RunFailed

SUPPORT = Path(__file__).resolve().parent


def graph(case: bugs.Case) -> Graph:
    inputs = ", ".join(f"{name}: src/{port}" for name, port in case.inputs.items())
    return load_text(
        "graph: bugs\nrecord: {snapshots: 100ms}\noperators:\n  src: {use: 'zoo.bugs:Numbers'}\n"
        f"  bug: {{use: 'zoo.bugs:{case.use.__name__}', inputs: {{{inputs}}}}}\n"
    )


def recorded(case: bugs.Case, path: Path) -> Path:
    """Records a run, by right code where the bug shows as a difference."""
    if case.differs:
        os.environ["ZOO_FIXED"] = "1"
    try:
        dataflow.run(graph(case), record=path)
    except RunFailed:  # the bug
        assert not case.differs
    finally:
        os.environ.pop("ZOO_FIXED", None)
    return path


def captured(case: bugs.Case, path: Path, test: Path) -> tuple[CaptureResult, int, float]:
    """Captures the bug; returns what was found, the bytes of its data, and seconds."""
    began = time.monotonic()
    with Recording(path) as recording:
        debugger = Debugger(recording, "bug")
        found = capture(recording, debugger, predicate=case.predicate)
        debugger.close()
    return found, write_test(found, test, path.name, "dataflow capture"), time.monotonic() - began


def outcomes(tests: Iterable[Path], *, fixed: bool) -> dict[str, bool]:
    """Runs tests by pytest in another process; by name, whether they pass."""
    environment = {name: value for name, value in os.environ.items() if name != "ZOO_FIXED"}
    environment |= {"PYTHONPATH": str(SUPPORT)} | ({"ZOO_FIXED": "1"} if fixed else {})
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "--tb=no", "-p", "no:cacheprovider", *map(str, tests)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=100, check=False, cwd=SUPPORT.parents[1]
    )
    told = [line.split() for line in done.stdout.splitlines() if line.startswith(("PASSED", "FAILED"))]
    return {Path(words[1].partition("::")[0]).stem: words[0] == "PASSED" for words in told}
