"""Recordings, streams, graphs and reports as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from dataflow.graph.model import Edge, Graph
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
    from dataflow.api.html import graph_svg

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


_BOX = (150, 40)
_GAP = (60, 18)
_DASHES = {"in": "", "sampled": "4 3", "batch": "1 3"}
_FILLS = {"source": "#dcefe0", "sink": "#f3e3d3", "middle": "#e3e9f5"}


def graph_svg(graph: Graph) -> str:
    """The drawing. Triggers are solid lines, `Sampled` inputs dashed, `Batch` inputs dotted; a line shows its stream
    when it is pointed at."""
    places = _places(layers(graph))
    width = max((x for x, _ in places.values()), default=0) + _BOX[0] + 8
    height = max((y for _, y in places.values()), default=0) + _BOX[1] + 8
    lines = [_line(graph, edge, places) for edge in graph.edges()]
    boxes = [_box(graph, name, *place) for name, place in places.items()]
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">{"".join(lines + boxes)}</svg>'


def layers(graph: Graph) -> list[list[str]]:
    """The operators by the longest way from a source; what goes back, as feedback does, is not counted."""
    order = {name: place for place, name in enumerate(graph.nodes)}
    depth = dict.fromkeys(graph.nodes, 0)
    edges = [edge for edge in graph.edges() if order[edge.producer] < order[edge.consumer]]
    for edge in sorted(edges, key=lambda edge: order[edge.consumer]):
        depth[edge.consumer] = max(depth[edge.consumer], depth[edge.producer] + 1)
    found: list[list[str]] = [[] for _ in range(max(depth.values(), default=-1) + 1)]
    for name, layer in depth.items():
        found[layer].append(name)
    return found


def _places(layered: list[list[str]]) -> dict[str, tuple[int, int]]:
    """The upper left corner of each operator's box; layers are centred."""
    most = max(map(len, layered), default=0)
    step_x, step_y = _BOX[0] + _GAP[0], _BOX[1] + _GAP[1]
    return {
        name: (4 + column * step_x, 4 + (most - len(names)) * step_y // 2 + row * step_y)
        for column, names in enumerate(layered)
        for row, name in enumerate(names)
    }


def _box(graph: Graph, name: str, x: int, y: int) -> str:
    node = graph.nodes[name]
    kind = "source" if node.source else "middle" if node.outputs else "sink"
    shown, kind_of = (escape(_short(word)) for word in (name, node.use.rpartition(":")[2]))
    middle = x + _BOX[0] // 2
    return (
        f'<g><title>{escape(node.use)}</title><rect x="{x}" y="{y}" width="{_BOX[0]}" height="{_BOX[1]}" rx="5" '
        f'fill="{_FILLS[kind]}" stroke="#667"/><text x="{middle}" y="{y + 17}" text-anchor="middle" font-size="12" '
        f'font-weight="bold">{shown}</text><text x="{middle}" y="{y + 32}" text-anchor="middle" font-size="10" '
        f'fill="#556">{kind_of}</text></g>'
    )


def _line(graph: Graph, edge: Edge, places: dict[str, tuple[int, int]]) -> str:
    (x0, y0), (x1, y1) = places[edge.producer], places[edge.consumer]
    x0, y0, y1 = x0 + _BOX[0], y0 + _BOX[1] // 2, y1 + _BOX[1] // 2
    bend = max(_GAP[0] // 2, abs(x1 - x0) // 2)
    port = graph.nodes[edge.consumer].input_port(edge.input)
    told = f"{graph.relative(edge.stream)} → {edge.consumer}.{edge.input}"
    return (
        f'<path d="M{x0},{y0} C{x0 + bend},{y0} {x1 - bend},{y1} {x1},{y1}" fill="none" stroke="#89a" '
        f'stroke-width="1.5" stroke-dasharray="{_DASHES[port.kind]}"><title>{escape(told)}</title></path>'
    )


def _short(word: str) -> str:
    return word if len(word) <= 22 else f"{word[:21]}…"
