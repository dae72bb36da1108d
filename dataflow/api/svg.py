"""A graph as an SVG drawing: operators in layers from the sources to the sinks, streams as lines. Pure."""

from __future__ import annotations

from html import escape

from dataflow.graph.model import Edge, Graph

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
