"""Recordings, streams, graphs and reports as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from dataflow.recording import StreamInfo
from dataflow.sync import format_stamp

if TYPE_CHECKING:
    from dataflow.graph.model import Graph
    from dataflow.supervision.core.report import RunReport
    from dataflow.verification.report import VerifyReport

_LEFT = ' style="text-align:left"'


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """An HTML table of text; every cell is escaped."""
    head = "".join(f"<th{_LEFT}>{escape(word)}</th>" for word in headings)
    body = "".join("<tr>" + "".join(f"<td{_LEFT}>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


class StreamFacts(NamedTuple):
    """One row of the table of streams: of a stream, or of a part of it."""

    name: str
    info: StreamInfo
    messages: int
    first: int | None
    last: int | None

    def words(self) -> tuple[str, str, str]:
        """Type, number of messages, and rate in Hz by the timestamps."""
        info, count = self.info, self.messages
        kind = info.message_type.SCHEMA if info.message_type is not None else info.schema or info.encoding
        if info.static:
            return kind, f"{count:,}", "static"
        span = 0 if self.first is None or self.last is None else self.last - self.first
        return kind, f"{count:,}", f"{(count - 1) / (span * 1e-9):.2f}" if span > 0 else ""


def recording_html(path: Path, start: int, duration: float, prefix: str, streams: Sequence[StreamFacts]) -> str:
    """Lists what a recording holds: a row for each stream that has messages; the empty ones are named below.

    `prefix`: the beginning of names that is not shown.
    """
    rows = [(stream.name.removeprefix(prefix), *stream.words()) for stream in streams if stream.messages]
    empty = ", ".join(stream.name.removeprefix(prefix) for stream in streams if not stream.messages)
    title = f"<b>{escape(str(path))}</b>, {duration:.3f} s from {escape(format_stamp(start))}"
    more = f"<p>without messages: {escape(empty)}</p>" if empty else ""
    return f"<div>{title}{table(('stream', 'type', 'messages', 'Hz'), rows)}{more}</div>"


def stream_html(stream: StreamFacts) -> str:
    """Describes a stream: its fields with their type, unit and meaning."""
    from dataflow.messages.declaration import field_text

    kind, count, rate = stream.words()
    title = f"<b>{escape(stream.name)}</b>: {count} {escape(kind)}{f', {rate} Hz' if rate else ''}"
    if stream.info.message_type is None:
        return f"<div>{title}</div>"
    rows = [(f.name, field_text(f), getattr(f, "unit", ""), f.doc) for f in stream.info.message_type.FIELDS]
    return f"<div>{title}{table(('field', 'type', 'unit', 'meaning'), rows)}</div>"


def graph_html(graph: Graph) -> str:
    """A graph: a drawing, and a row for each operator with what it takes and gives."""
    from dataflow.api.svg import graph_svg

    rows = []
    for node in graph.nodes.values():
        taken = [
            f"{port} ← {', '.join(map(graph.relative, streams))}" for port, streams in node.inputs.items() if streams
        ]
        made = [
            f"{graph.relative(stream)}: {' | '.join(graph.streams[stream].types)}" for stream in node.outputs.values()
        ]
        rows.append((node.name, node.use, "\n".join(taken), "\n".join(made)))
    title = f"<b>{escape(graph.name)}</b>, namespace {escape(graph.namespace)}"
    shown = table(("operator", "class", "inputs", "outputs"), rows).replace("\n", "<br/>")
    return f"<div>{title}<div>{graph_svg(graph)}</div>{shown}</div>"


def run_html(report: RunReport) -> str:
    """Sums up a run: a row for each operator, and what metrics sinks report."""
    rows = [
        (name, f"{c.firings:,}", f"{c.emitted:,}", f"{c.dropped:,}", f"{c.cpu_ns * 1e-9:.3f}")
        for name, c in report.operators.items()
    ]
    figures = [
        (name, figure, f"{value:.6g}" if isinstance(value, float) else str(value))
        for name, summary in report.summaries.items()
        for figure, value in summary.items()
    ]
    outcome = "interrupted" if report.interrupted else "complete"
    title = f"<b>{escape(report.graph)}</b>: {outcome} in {report.wall:.2f} s"
    summed = table(("operator", "figure", "value"), figures) if figures else ""
    return f"<div>{title}{table(('operator', 'firings', 'messages', 'dropped', 'CPU s'), rows)}{summed}</div>"


def verify_html(report: VerifyReport) -> str:
    """Sums up a verification: its verdict, and a row for each operator."""
    rows = [
        (v.operator, report.verdict(v), f"{v.verified:,} of {v.firings:,}", f"{v.outputs:,}", f"{v.differing:,}")
        for v in report.operators
    ]
    verdict = "identical" if report.identical else "not identical"
    headings = ("operator", "verdict", "firings repeated", "messages compared", "differing")
    return f"<div><b>{verdict}</b>, {report.messages:,} messages in {report.wall:.2f} s{table(headings, rows)}</div>"
