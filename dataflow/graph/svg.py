"""A graph as an SVG picture: a box per operator in the colour of its host, a line per stream and input."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from dataflow.graph.layout import Box, Layout, Link, Point, place
from dataflow.graph.model import Graph, Node

MARGIN = 28.0
HEADER = 46.0
PORT = 20.0
CHARACTER = 6.7
"""Width allowed for one character of a 12-pixel label."""
SMALL = 5.6
"""The same for a 10-pixel one."""
CORNER = 9.0

PALETTE = (
    ("#e8f1fb", "#2f6fb3"),
    ("#e9f6ec", "#2e8b57"),
    ("#fdf1e2", "#c77d1e"),
    ("#f5ebf8", "#8e4fa8"),
    ("#fdeaea", "#c0504d"),
    ("#e6f5f5", "#23868a"),
    ("#f6f3e0", "#93831f"),
    ("#eeeef7", "#5a5aa6"),
)
"""Fill and line of a host; they repeat when there are more hosts."""

_STYLE = """
text { font-family: "Inter", "Segoe UI", "Helvetica Neue", Arial, "DejaVu Sans", sans-serif; fill: #1f2933; }
.title { font-size: 17px; font-weight: 600; }
.name { font-size: 13px; font-weight: 600; }
.class { font-size: 10.5px; fill: #5b6773; }
.port { font-size: 11.5px; }
.type { font-size: 10px; fill: #6b7784; paint-order: stroke; stroke: #ffffff; stroke-width: 3px; }
.note { font-size: 10.5px; font-weight: 400; fill: #5b6773; }
.line { fill: none; stroke: #77838f; stroke-width: 1.5; }
.sampled { stroke-dasharray: 5 4; }
.batch { stroke-width: 5; }
.inner { stroke: #ffffff; stroke-width: 2.2; fill: none; }
.optional { fill: #9aa5b1; font-style: italic; }
"""


def svg(graph: Graph) -> str:
    """The picture as SVG text: self-contained, no script, readable in any browser."""
    nodes = list(graph.nodes.values())
    links = [
        Link(e.producer, e.port, e.consumer, e.input, f"{e.stream} {graph.nodes[e.consumer].input_port(e.input).kind}")
        for e in graph.edges()
    ]
    layout = place([_box(graph, node) for node in nodes], links)
    hosts = list(graph.hosts())
    colour = {host: PALETTE[i % len(PALETTE)] for i, host in enumerate(hosts)}
    shared = [(host, names) for host, names in graph.hosts().items() if len(names) > 1]
    width = max(layout.width + 2 * MARGIN, 640.0)
    top = MARGIN + 34
    height = top + layout.height + MARGIN + 44 + (18 if shared else 0)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" role="img">',
        f"<title>{escape(graph.name)}</title>",
        f"<style>{_STYLE}</style>",
        _markers(),
        f'<rect width="{width:.0f}" height="{height:.0f}" rx="10" fill="#ffffff"/>',
        f'<text class="title" x="{MARGIN:.0f}" y="{MARGIN + 10:.0f}">{escape(graph.name)}'
        f'<tspan class="note" dx="10">{escape(graph.namespace)} · {_count(len(nodes), "operator")} · '
        f"{_count(len(hosts), 'host')}</tspan></text>",
        f'<g transform="translate({MARGIN:.0f} {top:.0f})">',
    ]
    parts += [_line(graph, link, layout) for link in _by_weight(graph, links)]
    parts += [_draw(graph, node, layout, colour[node.host]) for node in nodes]
    parts += [_type_label(graph, node, port, layout) for node in nodes for port in node.outputs]
    parts += ["</g>", _legend(height - MARGIN + 4)]
    if shared:
        words = "   ".join(f"{host}: {', '.join(names)}" for host, names in shared)
        parts.append(_text("note", MARGIN, height - MARGIN - 16, f"shared hosts   {words}"))
    return "\n".join([*parts, "</svg>", ""])


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def _box(graph: Graph, node: Node) -> Box:
    rows = max(len(node.inputs), len(node.outputs), 1)
    ports = [HEADER + PORT * (i + 0.5) for i in range(rows)]
    title = max(len(node.name) * 7.8, len(_subtitle(node)) * 6.0)
    left = max((len(p) for p in node.inputs), default=0)
    right = max((len(p) for p in node.outputs), default=0)
    labels = max((len(_types(graph, s)) for s in node.outputs.values()), default=0)
    return Box(
        name=node.name,
        width=max(120.0, title + 24, (left + right) * CHARACTER + 44),
        height=HEADER + PORT * rows + 8,
        inputs=dict(zip(node.inputs, ports, strict=False)),
        outputs=dict(zip(node.outputs, ports, strict=False)),
        room=labels * SMALL + 14 if labels else 0.0,
    )


def _subtitle(node: Node) -> str:
    name = node.use.rpartition(":")[2]
    return f"{name} · {node.process}" if node.process else name


def _types(graph: Graph, stream: str) -> str:
    return " | ".join(graph.streams[stream].types) + (" (static)" if graph.streams[stream].static else "")


def _draw(graph: Graph, node: Node, layout: Layout, colour: tuple[str, str]) -> str:
    (x, y), width = layout.boxes[node.name], layout.widths[node.name]
    box = _box(graph, node)
    fill, stroke = colour
    parts = [
        f'<g id="{escape(node.name)}">',
        f"<title>{escape(node.name)}: {escape(node.use)}</title>",
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{box.height:.1f}" rx="7" fill="{fill}" '
        f'stroke="{stroke}" stroke-width="1.4"/>',
        _text("name", x + 12, y + 20, node.name),
        _text("class", x + 12, y + 35, _subtitle(node)),
        f'<path d="M {x:.1f} {y + HEADER - 3:.1f} h {width:.1f}" stroke="{stroke}" stroke-opacity="0.25"/>',
    ]
    for port, offset in box.inputs.items():
        wired = bool(node.inputs[port])
        if wired:
            parts.append(f'<circle cx="{x:.1f}" cy="{y + offset:.1f}" r="3" fill="{stroke}"/>')
        parts.append(_text("port" if wired else "port optional", x + 11, y + offset + 4, port))
    for port, offset in box.outputs.items():
        parts.append(f'<circle cx="{x + width:.1f}" cy="{y + offset:.1f}" r="3" fill="{stroke}"/>')
        parts.append(_text("port", x + width - 11, y + offset + 4, port, anchor="end"))
    return "".join([*parts, "</g>"])


def _type_label(graph: Graph, node: Node, port: str, layout: Layout) -> str:
    (x, y), width = layout.boxes[node.name], layout.widths[node.name]
    offset = _box(graph, node).outputs[port]
    return _text("type", x + width + 8, y + offset - 6, _types(graph, node.outputs[port]))


def _text(kind: str, x: float, y: float, words: str, anchor: str = "start") -> str:
    where = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{kind}" {where} xml:space="preserve">{escape(words)}</text>'


def _by_weight(graph: Graph, links: Sequence[Link]) -> list[Link]:
    """Broad lines first, so that thin ones stay visible where they cross."""
    return sorted(links, key=lambda link: graph.nodes[link.consumer].input_port(link.input).kind != "batch")


def _line(graph: Graph, link: Link, layout: Layout) -> str:
    kind = graph.nodes[link.consumer].input_port(link.input).kind
    points = layout.routes[link]
    path = _rounded(points) if link in layout.back else _smooth(points)
    stream = graph.nodes[link.producer].outputs[link.output]
    title = f"<title>{escape(graph.relative(stream))} ({kind}) to {escape(link.consumer)}.{escape(link.input)}</title>"
    drawn = f'<path class="line {kind}" d="{path}" marker-end="url(#arrow)"/>'
    if kind == "batch":
        drawn = f'<path class="line batch" d="{path}"/><path class="inner" d="{path}"/>'
    return f'<g class="edge">{title}{drawn}</g>'


def _smooth(points: Sequence[Point]) -> str:
    """Level stretches joined by S-curves."""
    (x, y), *rest = points
    path = [f"M {x:.1f} {y:.1f}"]
    for nx, ny in rest:
        if abs(ny - y) < 0.05:
            path.append(f"L {nx:.1f} {ny:.1f}")
        else:
            middle = (x + nx) / 2
            path.append(f"C {middle:.1f} {y:.1f} {middle:.1f} {ny:.1f} {nx:.1f} {ny:.1f}")
        x, y = nx, ny
    return " ".join(path)


def _rounded(points: Sequence[Point]) -> str:
    """A line of level and upright stretches with round corners."""
    path = [f"M {points[0][0]:.1f} {points[0][1]:.1f}"]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        for neighbour, word in ((before, "L"), (after, "Q")):
            dx, dy = neighbour[0] - corner[0], neighbour[1] - corner[1]
            length = max(abs(dx) + abs(dy), 1e-6)
            step = min(CORNER, length / 2) / length
            near = f"{corner[0] + dx * step:.1f} {corner[1] + dy * step:.1f}"
            path.append(f"L {near}" if word == "L" else f"Q {corner[0]:.1f} {corner[1]:.1f} {near}")
    return " ".join([*path, f"L {points[-1][0]:.1f} {points[-1][1]:.1f}"])


def _markers() -> str:
    return (
        '<defs><marker id="arrow" viewBox="0 0 8 8" refX="9" refY="4" markerWidth="7" markerHeight="7" orient="auto" '
        'markerUnits="userSpaceOnUse"><path d="M 0 0.5 L 8 4 L 0 7.5 z" fill="#77838f"/></marker></defs>'
    )


def _legend(y: float) -> str:
    """The three kinds of line, below the picture."""
    parts, x = [], MARGIN
    for kind, words in (
        ("in", "triggers (In)"), ("sampled", "newest value (Sampled)"), ("batch", "all since last firing (Batch)"),
    ):  # fmt: skip
        path = f"M {x:.1f} {y - 4:.1f} h 30"
        parts.append(f'<path class="line {kind}" d="{path}"/>')
        if kind == "batch":
            parts.append(f'<path class="inner" d="{path}"/>')
        parts.append(_text("note", x + 38, y, words))
        x += 38 + len(words) * 5.8 + 26
    return "".join(parts)
