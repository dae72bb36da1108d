"""Prepares commands that make recorded calls again in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dataflow.cli.support.arguments import find_modules_in, graph_file
from dataflow.cli.support.output import fail, out

if TYPE_CHECKING:
    from dataflow.graph import Graph


def begin_again(
    recording: Path, graph: Path | None, settings: Sequence[str] | None, folders: Sequence[Path] | None
) -> Graph | None:
    """Makes operators importable, and this process one like those of the run; returns the graph that `--graph` names.

    Raises `GraphError`, and ends the command where `--set` has no graph file to change.
    """
    if graph is None and settings:
        raise fail("--set changes a graph file: name it with --graph")
    find_modules_in(folders)
    from dataflow.recording import Recording
    from dataflow.reexecution.recorded_run import resolved_graph

    with Recording(recording) as opened:
        recorded = resolved_graph(opened)
    take_environment(1 if recorded is None else recorded.threads)
    from dataflow.graph import load_graph

    return None if graph is None else load_graph(graph_file(graph), settings=settings or ())


def take_environment(threads: int) -> None:
    """Begins anew with the environment of operators where this process has another one: libraries read the number of
    their threads, and Python the salt of hashes, when they begin."""
    from dataflow.cli import start
    from dataflow.execution.threads import environment

    wanted = environment(threads)
    if start.words is not None and any(
        os.environ.get(name) != value for name, value in wanted.items() if name != "PYTHONPATH"
    ):
        out.file.flush()
        os.execve(sys.executable, [sys.executable, "-P", "-m", "dataflow.cli.main", *start.words], wanted)
