"""The summary of a run: for people, and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.columns import Columns
from rich.console import Console, Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from dataflow.cli.output import count, figure, plural, seconds, size, table
from dataflow.supervision.report import RunReport

_VALUE_WIDTH = 30
"""Columns that the text of a figure may take before it is folded."""


def print_report(console: Console, report: RunReport, *, total: float | None = None) -> None:
    """Prints operators, figures of metrics sinks side by side, drops, restarts, notes, files.

    `total`: seconds that the whole command took, with starting and closing its processes.
    """
    title = Text.assemble(
        (report.graph, "bold"),
        ("  interrupted", "yellow") if report.interrupted else ("  complete", "green"),
        f"  {timing(report)}",
        "" if total is None else f"; {seconds(total)} with start and end",
    )
    console.print(title)
    console.print(_operators(report))
    blocks = [
        Group(Text(operator, style="bold"), Padding(_figures(summary), (0, 0, 1, 2), expand=False))
        for operator, summary in report.summaries.items()
        if summary
    ]
    if blocks:
        console.print(Columns(blocks, padding=(0, 3)))
    if any(report.drops.values()):
        console.print(Text("dropped", style="bold yellow"))
        console.print(Padding(_reasons(report.drops), (0, 0, 1, 2), expand=False))
    if any(report.waits.values()):
        console.print(Text("waits given up (timeout), messages after their firing (late)", style="bold yellow"))
        console.print(Padding(_reasons(report.waits), (0, 0, 1, 2), expand=False))
    for operator, times in report.restarts.items():
        console.print(Text(f"{operator} was restarted {plural(times, 'time')}", style="yellow"))
    for note in report.notes:
        console.print(Text(f"note: {note}", style="dim"))
    for facts in report.files.values():
        if facts:
            line = f"wrote {facts['path']} ({plural(facts['messages'], 'message')}, {size(facts['bytes'])})"
            console.print(Text(line), soft_wrap=True)
            if facts.get("failed"):
                console.print(Text(f"  {plural(facts['failed'], 'message')} could not be drawn", style="yellow"))


def _operators(report: RunReport) -> Table:
    """A row for each operator; Hz is firings per second of event time."""
    numbers = ("firings", "out", "Hz", "dropped", "CPU time", "per firing")
    made = table("operator", *numbers, right=numbers)
    span = 0.0 if report.first is None or report.last is None else (report.last - report.first) * 1e-9
    for name, counts in report.operators.items():
        made.add_row(
            Text(name),
            count(counts.firings) if counts.firings else "",
            count(counts.emitted) if counts.emitted else "",
            f"{(counts.firings - 1) / span:.1f}" if counts.firings > 1 and span > 0 else "",
            Text(count(counts.dropped), style="yellow") if counts.dropped else "",
            f"{counts.busy_ns * 1e-9:.2f} s",
            f"{counts.busy_ns * 1e-6 / counts.firings:.2f} ms" if counts.firings else "",
        )
    return made


def _figures(summary: Mapping[str, Any]) -> Table:
    """One line a figure; the decimal values in a column of their own, with their unit."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold", max_width=_VALUE_WIDTH)
    for name, value in summary.items():
        label, text, unit = figure(name, value)
        grid.add_row(Text(label, style="dim"), Text(f"{text} {unit}".rstrip()))
    return grid


def _reasons(found: Mapping[str, tuple[tuple[str, str, int], ...]]) -> Table:
    """One line for each operator's input and reason."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column()
    grid.add_column(justify="right", no_wrap=True)
    grid.add_column(overflow="fold")
    for operator, rows in found.items():
        for input_name, reason, number in rows:
            where = f"{operator}.{input_name}" if input_name else operator
            grid.add_row(Text(where), count(number), Text(reason))
    return grid


def timing(report: RunReport) -> str:
    """Such as "8.30 s of event time in 4.10 s, 2.02 × real time"."""
    if report.first is None or report.last is None or report.last <= report.first:
        return seconds(report.wall)
    event = (report.last - report.first) * 1e-9
    return f"{seconds(event)} of event time in {seconds(report.wall)}, {event / max(report.wall, 1e-9):.2f} × real time"


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
            operator: [{"input": i, "reason": why, "count": n} for i, why, n in drops]
            for operator, drops in report.drops.items()
        },
        "waits": {
            operator: [{"input": i, "what": what, "count": n} for i, what, n in waits]
            for operator, waits in report.waits.items()
        },
        "restarts": dict(report.restarts),
        "summaries": {operator: dict(summary) for operator, summary in report.summaries.items()},
        "transport": {label: dict(counts) for label, counts in report.transport.items()},
        "files": {
            name: {key: str(value) if isinstance(value, Path) else value for key, value in facts.items()}
            for name, facts in report.files.items()
        },
        "notes": list(report.notes),
    }
