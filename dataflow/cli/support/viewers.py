"""Viewers that `run` and `replay` start: a process that attaches to the graph, a window for a saved file."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.markup import escape

from dataflow.cli.support.output import err, fail, say

READY_WITHIN = 20.0
"""Seconds that a run waits for its viewer's process to be ready before it starts."""
DRAW_WITHIN = 15.0
"""Seconds that a viewer gets to draw the rest when its run has ended."""


def require_display() -> None:
    """An error, with what to use instead, where no window can be opened."""
    from dataflow.view.process import display_problem

    if (problem := display_problem()) is not None:
        raise fail(
            f"cannot open a viewer window: {problem}; use serve (a page for a browser) or a file name ending in .rrd"
        )


def open_saved(path: Path) -> None:
    """Opens a saved viewer file in a window that stays; prints a note where there is no display."""
    from dataflow.view import ViewerError
    from dataflow.view.process import display_problem, start

    if (problem := display_problem()) is not None:
        say(f"{escape(str(path))} is not opened: {problem}; where there is one: rerun {escape(str(path))}")
        return
    try:
        start([str(path.resolve())], [], outlive=True)
    except (ViewerError, OSError) as error:
        say(f"[yellow]{escape(str(path))} is not opened: {escape(str(error))}[/]")
        return
    say(f"opening {escape(str(path))} in the viewer")


@contextmanager
def attached_viewer(target: str | None) -> Iterator[None]:
    """While the block runs: a viewer's process that attaches to this process's graph as soon as it runs.

    The block begins when that process is ready to attach, so that a short run is seen too. The viewer's output goes to
    standard error. Its failure never ends the run.
    """
    if target is None:
        yield
        return
    from dataflow.graph.search import import_path

    say(f"[dim]starting the viewer ({target})[/]")
    words = ["view", "--graph", str(os.getpid()), "--to", target, "--wait", "3600", "--until-end"]
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "dataflow.cli.main", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        process_group=0,
        env={**os.environ, "PYTHONPATH": import_path()},
    )
    ready, following = threading.Event(), threading.Event()
    reader = threading.Thread(target=_relay, args=(process, ready, following), daemon=True)
    reader.start()
    ready.wait(READY_WITHIN)
    try:
        yield
        if process.poll() is None and not following.is_set():
            say("[yellow]the run ended before the viewer could follow it; for short runs use --view FILE.rrd[/]")
    finally:
        _end(process, following.is_set())
        reader.join(timeout=2.0)


def _relay(process: subprocess.Popen[str], ready: threading.Event, following: threading.Event) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        ready.set()
        if line.startswith("following "):
            following.set()
        elif not line.startswith("waiting "):
            err.print(f"[dim]viewer:[/] {escape(line.rstrip())}", soft_wrap=True)
    ready.set()


def _end(process: subprocess.Popen[str], following: bool) -> None:
    """Lets the viewer draw the rest of a run that has ended; one that never saw it ends at once."""
    if not following:
        process.terminate()
    try:
        process.wait(timeout=DRAW_WITHIN)
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(timeout=5.0)
