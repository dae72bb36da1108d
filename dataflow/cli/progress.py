"""The live table of a running graph, the bar of a replay, and the summary at the end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from dataflow.cli.output import count, figures, size
from dataflow.runtime.execute import Watch
from dataflow.runtime.supervisor import OperatorCounts, RunReport, Status
from dataflow.sync import FOREVER, NEVER


class Rates:
    """Firings per second over the last second or so."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[float, int, float]] = {}

    def of(self, name: str, firings: int, now: float) -> float:
        at, before, rate = self._seen.get(name, (now, firings, 0.0))
        if now - at >= 0.8:
            rate = (firings - before) / (now - at)
            self._seen[name] = (now, firings, rate)
        else:
            self._seen.setdefault(name, (at, before, rate))
        return rate


class RunDisplay:
    """Renders a `Status`: a bar over event time (or steps) and a row for each operator."""

    def __init__(self, console: Console, *, span: tuple[int, int] | None = None) -> None:
        self.span = span
        self.rates = Rates()
        self.status: Status | None = None
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=40),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
        )
        self.task = self.bar.add_task("starting", total=None, note="")

    def update(self, status: Status) -> None:
        self.status = status
        total, completed, note = self._fraction(status)
        self.bar.update(self.task, description=status.phase, total=total, completed=completed, note=note)

    def _fraction(self, status: Status) -> tuple[float | None, float, str]:
        if self.span is not None:
            first, last = self.span
            reached = min(max(status.covered, first), last)
            if status.covered == FOREVER:
                reached = last
            return (last - first) * 1e-9, (reached - first) * 1e-9, f"{(reached - first) * 1e-9:.1f} s of event time"
        if status.steps is not None:
            sources = [c.firings for name, c in status.operators.items() if c.done != FOREVER and c.firings]
            done = min((c for c in sources), default=0)
            return float(status.steps), float(done), f"{done} of {status.steps} steps"
        return None, 0.0, ""

    def __rich__(self) -> RenderableType:
        parts: list[RenderableType] = [self.bar]
        if self.status is not None and self.status.operators:
            parts.append(self._table(self.status))
        return Group(*parts)

    def _table(self, status: Status) -> Table:
        now = time.monotonic()
        table = Table(box=None, pad_edge=False, header_style="dim")
        table.add_column("operator")
        table.add_column("host", style="dim")
        for name in ("firings", "Hz", "out", "dropped", "busy", "lag"):
            table.add_column(name, justify="right")
        reached = [c.done for c in status.operators.values() if c.done not in (NEVER, FOREVER)]
        front = max(reached, default=None)
        for name, counts in status.operators.items():
            rate = self.rates.of(name, counts.firings or counts.emitted, now)
            elapsed = max(time.time() - status.started, 1e-9)
            table.add_row(
                name,
                status.host_of.get(name, ""),
                count(counts.firings) if counts.firings else "",
                f"{rate:.1f}",
                count(counts.emitted),
                Text(count(counts.dropped), style="yellow") if counts.dropped else "",
                f"{counts.busy_ns * 1e-9 / elapsed:.0%}",
                _lag(counts, front),
            )
        return table


def _lag(counts: OperatorCounts, front: int | None) -> str:
    if counts.done == FOREVER:
        return "done"
    if counts.done == NEVER or front is None:
        return "–"
    return f"{(front - counts.done) * 1e-9:.2f} s"


@contextmanager
def shown(console: Console, display: RunDisplay, *, quiet: bool) -> Iterator[Watch | None]:
    """Shows `display` while the block runs; a terminal gets a live table, a log a line every few seconds."""
    if quiet:
        yield None
        return
    if not console.is_terminal:
        yield _line_printer(console, display)
        return
    with Live(display, console=console, refresh_per_second=5, transient=True):
        yield display.update


def _line_printer(console: Console, display: RunDisplay, every: float = 5.0) -> Watch:
    due, phase = time.monotonic() + 1.0, ""

    def watch(status: Status) -> None:
        nonlocal due, phase
        display.update(status)
        now = time.monotonic()
        if now >= due or status.phase != phase:
            due, phase = now + every, status.phase
            _, _, note = display._fraction(status)
            console.print(f"{status.phase:<8} {time.time() - status.started:5.1f} s  {note}")

    return watch


def print_report(console: Console, report: RunReport) -> None:
    """The summary of a run: operators, figures of metrics sinks, drops, files."""
    table = Table(title=f"{report.graph}: {'interrupted' if report.interrupted else 'complete'}", title_justify="left")
    table.add_column("operator")
    for name in ("firings", "out", "dropped", "work", "per firing"):
        table.add_column(name, justify="right")
    for name, counts in report.operators.items():
        per = counts.busy_ns * 1e-6 / counts.firings if counts.firings else None
        table.add_row(
            name,
            count(counts.firings) if counts.firings else "",
            count(counts.emitted),
            Text(count(counts.dropped), style="yellow") if counts.dropped else "0",
            f"{counts.busy_ns * 1e-9:.2f} s",
            "" if per is None else f"{per:.2f} ms",
        )
    console.print(table)
    for operator, drops in report.drops.items():
        for input_name, reason, number in drops:
            console.print(f"  [yellow]dropped[/] {operator}.{input_name}: {number} × {reason}")
    for operator, summary in report.summaries.items():
        console.print(f"  [bold]{operator}[/]  {figures(summary)}")
    for note in report.notes:
        console.print(f"  [dim]note: {note}[/]")
    console.print(f"  {timing(report)}")
    for facts in report.files.values():
        if facts:
            console.print(f"  wrote {facts['path']} ({count(facts['messages'])} messages, {size(facts['bytes'])})")


def timing(report: RunReport) -> str:
    """"8.3 s of event time in 4.1 s: 2.0 × real time"."""
    if report.first is None or report.last is None or report.last <= report.first:
        return f"{report.wall:.1f} s"
    span = (report.last - report.first) * 1e-9
    return f"{span:.1f} s of event time in {report.wall:.1f} s: {span / max(report.wall, 1e-9):.2f} × real time"


def report_json(report: RunReport) -> dict[str, Any]:
    """A `RunReport` as JSON values."""
    return {
        "graph": report.graph,
        "complete": not report.interrupted,
        "wall_s": report.wall,
        "first_stamp": report.first,
        "last_stamp": report.last,
        "operators": {
            name: {"firings": c.firings, "emitted": c.emitted, "dropped": c.dropped, "busy_ms": c.busy_ns * 1e-6}
            for name, c in report.operators.items()
        },
        "streams": {name: {"messages": n, "digest": digest} for name, (n, digest) in report.streams.items()},
        "drops": {
            op: [{"input": i, "reason": why, "count": n} for i, why, n in drops] for op, drops in report.drops.items()
        },
        "summaries": dict(report.summaries),
        "transport": dict(report.transport),
        "files": {name: {k: str(v) if isinstance(v, Path) else v for k, v in f.items()} for name, f in report.files.items()},
        "notes": list(report.notes),
    }
