"""The summary of a run: for people, and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.columns import Columns
from rich.console import Console, Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from dataflow.cli.support.output import called, count, plural, seconds, size, table
from dataflow.operator import FINDING
from dataflow.records.figures import figures, words_of
from dataflow.supervision.core.report import RunReport
from dataflow.sync import MISSES, TICK
from dataflow.sync.stamps import format_stamp

_VALUE_WIDTH = 30
"""Columns that the text of a figure may take before it is folded."""


SCORES = frozenset({"rmse", "precision", "recall", "f1", "ap50", "iou", "miou", "accuracy", "error"})
"""Words in the names of figures that say how good something is."""
MOST_SCORES, MOST_LOSSES, MOST_KEPT = 3, 4, 5
SCORES_IN_ALL = 6
"""Of all operators, at least one of each."""


def print_report(console: Console, report: RunReport, *, total: float | None = None, verbose: bool = True) -> None:
    """Prints what matters first: scores or rates, losses, files. `verbose`: then tables of operators, figures, losses.

    `total`: seconds that the whole command took, with starting and closing its processes.
    """
    title = Text.assemble(
        (report.graph, "bold"),
        _outcome(report),
        f"  {timing(report)}",
        "" if total is None else f"; {seconds(total)} with start and end",
    )
    console.print(title)
    lost = _losses_in_short(report) if report.wall else None
    for line in (_scores(report) or _rates(report), lost, *_findings(report), *_files(report)):
        if line is not None:
            console.print(line, soft_wrap=line.plain.startswith(WROTE))
    for operator, times in report.restarts.items():
        console.print(Text(f"{operator} was restarted {plural(times, 'time')}", style="yellow"))
    for note in dict.fromkeys(report.notes):
        console.print(Text(f"note: {note}", style="dim"))
    if verbose:
        _print_tables(console, report)


def _print_tables(console: Console, report: RunReport) -> None:
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


def is_score(name: str) -> bool:
    """Returns whether a figure, alone or after its operator ("operator: name"), measures how good something is."""
    return bool(SCORES & words_of(name))


def _scores(report: RunReport) -> Text | None:
    """The first scores of each operator that sums some up; None where none does."""
    found = []
    for operator, summary in report.summaries.items():
        numbers = {name: value for name, value in summary.items() if isinstance(value, int | float)}
        scores = [f"{name} {text}" for name, text in figures(numbers).items() if is_score(name)]
        if scores:
            found.append((operator, scores))
    most = max(1, min(MOST_SCORES, SCORES_IN_ALL // max(1, len(found))))
    words = [f"{operator}: {', '.join(scores[:most])}" for operator, scores in found]
    return Text(f"scores  {'; '.join(words)}") if found else None


def _findings(report: RunReport) -> list[Text]:
    """Returns what operators found wrong with what they were given, a line each."""
    found = [(name, summary[FINDING]) for name, summary in report.summaries.items() if FINDING in summary]
    return [Text(f"found   {name}: {text}", style="yellow") for name, text in found]


def _rates(report: RunReport) -> Text | None:
    """The rate of every source, and of the slowest operator behind them."""
    rates = {name: rate for name in report.operators if (rate := _rate(report, name)) is not None}
    given = (*report.sources, "@log")
    sources = {name: rate for name, rate in rates.items() if name in given}
    others = {name: rate for name, rate in rates.items() if name not in given}
    if not rates:
        return None
    words = [f"{called(name)} {rate:.1f} Hz" for name, rate in sources.items()]
    if others:
        slowest = min(others, key=lambda name: others[name])
        words.append(f"{'slowest: ' if len(others) > 1 else ''}{slowest} {others[slowest]:.1f} Hz")
    return Text(f"rates   {', '.join(words)}")


def _rate(report: RunReport, operator: str) -> float | None:
    """Firings per second of event time; None where there is no span of it."""
    firings = report.operators[operator].firings
    if report.first is None or report.last is None or report.last <= report.first or firings < 2:
        return None
    return (firings - 1) / ((report.last - report.first) * 1e-9)


def _losses_in_short(report: RunReport) -> Text:
    """Drops by input, the most first, and what no recording holds; waits and misses are in the table."""
    found = [(n, operator, name, why) for operator, name, why, n in dropped(report)]
    worst = [
        f"{n:,} {_where(operator, name)} ({_meaning(name, why) or why})"
        for n, operator, name, why in sorted(found)[::-1]
    ]
    words = []
    if found:
        more = f", and at {plural(len(worst) - MOST_LOSSES, 'more input')}" if len(worst) > MOST_LOSSES else ""
        words.append(f"{plural(sum(n for n, *_ in found), 'message')} dropped: {', '.join(worst[:MOST_LOSSES])}{more}")
    for facts in report.files.values():
        if lost := facts.get("lost"):
            words.append(_not_recorded(lost))
        words += [
            f"what {one['path']} was to keep ({one['reasons'][0]['what']}): {one['error']}" for one in _not_kept(facts)
        ]
        if deaths := facts.get("deaths"):
            words.append(
                f"what the recorder, which died {plural(deaths, 'time')}, had not stored, and what came until the next "
                "one began: the files before lie beside the last ones"
            )
    return Text(f"lost    {'; '.join(words) or 'nothing'}", style="yellow" if words else "")


def dropped(report: RunReport) -> list[tuple[str, str, str, int]]:
    """Returns (operator, input, reason, count) of what was dropped; a miss is none."""
    return [(o, name, why, n) for o, drops in report.drops.items() for name, why, n in drops if why not in MISSES and n]


def _not_recorded(lost: Mapping[str, Any]) -> str:
    spans = [
        f"{format_stamp(since)} to {'the end' if until is None else format_stamp(until)}"
        for since, until in lost["spans"]
    ]
    when = f", from {' and from '.join(spans)}" if spans else ""
    count_of = f"{plural(lost['messages'], 'message')} and {plural(lost['firings'], 'call')} not recorded"
    if not (lost["messages"] or lost["firings"] or spans):
        count_of = "the end of a file"
    return f"{count_of}{when} ({lost['reasons'][0]})" if lost["reasons"] else f"{count_of}{when}"


WROTE = "wrote   "


def _files(report: RunReport) -> list[Text]:
    lines: list[Text] = []
    for facts in report.files.values():
        if "kept" in facts:
            lines += _kept(facts)
        elif facts:
            lines.append(Text(WROTE + _written(facts)))
        if facts.get("failed"):
            lines.append(Text(f"        {plural(facts['failed'], 'message')} could not be drawn", style="yellow"))
    return lines


def _kept(facts: Mapping[str, Any]) -> list[Text]:
    """Returns lines about the recordings that a flight recorder kept, and how often it was asked for more."""
    kept = [one for one in facts["kept"] if "error" not in one]
    lines = [
        Text(f"kept    {one['path']} ({one['reasons'][0]['what']}, {size(one['bytes'])})") for one in kept[:MOST_KEPT]
    ]
    if len(kept) > MOST_KEPT:
        lines.append(Text(f"kept    {len(kept) - MOST_KEPT} more in {facts['path']}"))
    if not kept:
        lines.append(Text("kept    nothing" + ("" if facts["kept"] else ": no trigger came")))
    if more := facts["not_kept"]:
        lines.append(Text(f"        {plural(more, 'more trigger')} came, of which nothing is kept: raise files:"))
    return lines


def _not_kept(facts: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Returns the recordings that a flight recorder was asked for and could not keep."""
    return [one for one in facts.get("kept", ()) if "error" in one]


def is_lacking(facts: Mapping[str, Any]) -> bool:
    """Returns whether the files of a sink lack anything of what they were to hold."""
    return bool(facts.get("lost") or facts.get("deaths") or _not_kept(facts))


def _written(facts: Mapping[str, Any]) -> str:
    parts = facts.get("parts", ())
    last = f" to {Path(parts[-1]).name}" if len(parts) > 1 else ""
    words = [plural(facts["messages"], "message"), size(facts["bytes"])]
    if len(parts) > 1:
        words.insert(0, f"{len(parts)} files")
    if facts.get("deleted"):
        words.append(f"{plural(facts['deleted'], 'older file')} deleted")
    return f"{facts['path']}{last} ({', '.join(words)})"


def _where(operator: str, input_name: str) -> str:
    return f"{operator}.{input_name}" if input_name else operator


def _outcome(report: RunReport) -> tuple[str, str]:
    """The outcome in words, and the style of them."""
    if not report.interrupted:
        return "  complete", "green"
    return "  interrupted" if report.wall else "  interrupted while starting", "yellow"


def _operators(report: RunReport) -> Table:
    """Returns a row for each operator; Hz is firings per second of event time, CPU that of its calls, wall s their
    wall time. Figures that are zero for all operators have no column."""
    timeouts, late = _total(report.waits, "timeout"), _total(report.waits, "late")
    lost: Counter[str] = Counter()
    for operator, _, _, number in dropped(report):
        lost[operator] += number
    counted: dict[str, Mapping[str, int]] = {
        heading: numbers
        for heading, numbers in (("dropped", lost), ("timeouts", timeouts), ("late", late))
        if any(numbers.values())
    }
    numbers = ("firings", "out", "Hz", *counted, "CPU s", "ms each", "wall s")
    made = table("operator", *numbers, right=numbers)
    made.padding = (0, 0, 0, 0 if counted else 1)  # one that has all columns fits 80
    made.columns[0].min_width = 12
    for name, counts in report.operators.items():
        made.add_row(
            Text(called(name)),
            count(counts.firings) if counts.firings else "",
            count(counts.emitted) if counts.emitted else "",
            "" if (rate := _rate(report, name)) is None else f"{rate:.1f}",
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
    """Returns one line a figure; the decimal values in a separate column, with their unit."""
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
            what = reason if reason in MISSES else f"dropped: {reason}"
            _add(made, operator, input_name, what, number, _meaning(input_name, reason))
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
    made.add_row(
        Text(_where(operator, input_name)), Text(what, style="yellow"), count(number), Text(meaning, style="dim")
    )


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
        "namespace": report.namespace,
        "complete": not report.interrupted,
        "wall_s": report.wall,
        "first_stamp": report.first,
        "last_stamp": report.last,
        "operators": {
            name: {
                "firings": c.firings,
                "emitted": c.emitted,
                "dropped": sum(n for operator, _, _, n in dropped(report) if operator == name),
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
