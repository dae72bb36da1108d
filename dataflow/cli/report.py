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

from dataflow.cli.output import count, plural, seconds, size, table
from dataflow.records.figures import figures
from dataflow.supervision.report import RunReport
from dataflow.sync import TICK

_VALUE_WIDTH = 30
"""Columns that the text of a figure may take before it is folded."""


def print_report(console: Console, report: RunReport, *, total: float | None = None) -> None:
    """Prints operators, figures of metrics sinks side by side, losses, restarts, notes, files.

    `total`: seconds that the whole command took, with starting and closing its processes.
    """
    title = Text.assemble(
        (report.graph, "bold"),
        _outcome(report),
        f"  {timing(report)}",
        "" if total is None else f"; {seconds(total)} with start and end",
    )
    console.print(title)
    if report.wall:
        console.print(_operators(report))
    blocks = [
        Group(Text(operator, style="bold"), Padding(_figures(summary), (0, 0, 1, 2), expand=False))
        for operator, summary in report.summaries.items()
        if summary
    ]
    if blocks:
        console.print(Columns(blocks, padding=(0, 3)))
    if any(report.drops.values()) or any(report.waits.values()):
        console.print(_losses(report))
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


def _outcome(report: RunReport) -> tuple[str, str]:
    """The outcome in words, and the style of them."""
    if not report.interrupted:
        return "  complete", "green"
    return "  interrupted" if report.wall else "  interrupted while starting", "yellow"


def _operators(report: RunReport) -> Table:
    """A row for each operator; Hz is firings per second of event time, CPU that of its calls, wall s their
    wall time. What is nothing of all has no column."""
    timeouts, late = _total(report.waits, "timeout"), _total(report.waits, "late")
    dropped = {name: counts.dropped for name, counts in report.operators.items()}
    counted = {
        heading: numbers
        for heading, numbers in (("dropped", dropped), ("timeouts", timeouts), ("late", late))
        if any(numbers.values())
    }
    numbers = ("firings", "out", "Hz", *counted, "CPU s", "ms each", "wall s")
    made = table("operator", *numbers, right=numbers)
    made.padding = (0, 0, 0, 0 if counted else 1)  # one that has all columns fits 80
    made.columns[0].min_width = 12
    span = 0.0 if report.first is None or report.last is None else (report.last - report.first) * 1e-9
    for name, counts in report.operators.items():
        made.add_row(
            Text(name),
            count(counts.firings) if counts.firings else "",
            count(counts.emitted) if counts.emitted else "",
            f"{(counts.firings - 1) / span:.1f}" if counts.firings > 1 and span > 0 else "",
            *(Text(count(n) if (n := of.get(name, 0)) else "", style="yellow") for of in counted.values()),
            f"{counts.cpu_ns * 1e-9:,.2f}",
            f"{counts.cpu_ns * 1e-6 / counts.firings:,.2f}" if counts.firings else "",
            f"{counts.wall_ns * 1e-9:,.2f}",
        )
    return made


Rows = Mapping[str, tuple[tuple[str, str, int], ...]]
"""Each operator's (input, what or why, count)."""


def _total(rows: Rows, wanted: str) -> dict[str, int]:
    return {operator: sum(n for _, what, n in found if what == wanted) for operator, found in rows.items()}


def _figures(summary: Mapping[str, Any]) -> Table:
    """One line a figure; the decimal values in a column of their own, with their unit."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold", max_width=_VALUE_WIDTH)
    for label, text in figures(summary).items():
        grid.add_row(Text(label, style="dim"), Text(text))
    return grid


_MEANS = {
    "overflow": "the queue was full",
    "late": "came after its firing",
    "past": "its stamp lay before one that was sent",
    "repeated": "had been sent before the restart",
    "missed": "lost on its way to the process",
    "reset": "waited when a clock jumped back",
    "refused": "contradicted its stream's own promise",
    "non_monotonic": "not sent: its stamp did not increase",
    "unmatched": "no partner of its stamp",
    "no_sample": "nothing to sample yet",
    "stale": "what it would be joined with was too old",
    "unused": "no firing needed it",
}


def _losses(report: RunReport) -> Table:
    """A line for each operator's input and what happened there: drops, timeouts and late messages apart."""
    made = table("input", "what", "number", "", right=("number",))
    for operator in dict.fromkeys((*report.operators, *report.drops, *report.waits)):
        drops = report.drops.get(operator, ())
        for input_name, reason, number in drops:
            _add(made, operator, input_name, f"dropped: {reason}", number, _meaning(input_name, reason))
        dropped_late = {input_name: n for input_name, reason, n in drops if reason == "late"}
        for input_name, what, number in report.waits.get(operator, ()):
            if what == "timeout":
                _add(made, operator, input_name, what, number, "wait given up, nothing dropped")
            elif kept := number - dropped_late.get(input_name, 0):
                _add(made, operator, input_name, what, kept, "after its firing, for later ones")
    return made


def _meaning(input_name: str, reason: str) -> str:
    if input_name == TICK:
        return "came due while it was at work"
    return _MEANS.get(reason, "")


def _add(made: Table, operator: str, input_name: str, what: str, number: int, meaning: str) -> None:
    where = f"{operator}.{input_name}" if input_name else operator
    made.add_row(Text(where), Text(what, style="yellow"), count(number), Text(meaning, style="dim"))


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
            name: {
                "firings": c.firings,
                "emitted": c.emitted,
                "dropped": c.dropped,
                "cpu_ms": c.cpu_ns * 1e-6,
                "wall_ms": c.wall_ns * 1e-6,
            }
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
