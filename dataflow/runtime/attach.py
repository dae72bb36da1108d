"""Tools that follow a running graph from outside: viewers, `echo`, `hz`. They hold nobody up."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def attached_viewer(graph: str, target: str | None) -> Iterator[None]:
    """While the block runs: a viewer process that attaches to the graph of that name once it runs."""
    if target is None:
        yield
        return
    command = [sys.executable, "-m", "dataflow.cli.main", "view", "--graph", graph, f"--{target}", "--wait", "60"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, process_group=0)
    try:
        yield
    finally:
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait(timeout=5.0)
