"""A layered layout for graph pictures: which column and height each box gets, and the way of each line.

After Sugiyama, Tagawa and Toda (1981): columns by longest path, long lines led through the columns between, fewer
crossings by barycentre sweeps, and heights by least squares under minimal distances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

COLUMN_GAP = 72.0
ROW_GAP = 26.0
LANE_GAP = 14.0
SWEEPS = 12

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Box:
    """A box to place: its size, the height of its ports below its top, and the room it wants to its right."""

    name: str
    width: float
    height: float
    inputs: Mapping[str, float]
    outputs: Mapping[str, float]
    room: float = 0.0


@dataclass(frozen=True, slots=True)
class Link:
    """A line from an output port to an input port. Lines of one `bundle` run together where they can."""

    producer: str
    output: str
    consumer: str
    input: str
    bundle: str


@dataclass(frozen=True, slots=True)
class Layout:
    """Left and top of every box, its drawn width, and the points of every link; `back`: links against the flow."""

    boxes: Mapping[str, Point]
    widths: Mapping[str, float]
    routes: Mapping[Link, Sequence[Point]]
    back: frozenset[Link]
    width: float
    height: float


@dataclass(slots=True)
class _Item:
    """A box, or a point where a long line passes a column. `links`: (other item, own port offset, other's offset)."""

    height: float
    order: int
    links: list[tuple[_Item, float, float]] = field(default_factory=list)
    top: float = 0.0


def place(boxes: Sequence[Box], links: Sequence[Link]) -> Layout:
    """The layout of boxes given in flow order: a link to a box at or before its producer runs back underneath."""
    index = {box.name: i for i, box in enumerate(boxes)}
    back = frozenset(link for link in links if index[link.consumer] <= index[link.producer])
    forward = [link for link in links if link not in back]
    column = _columns(boxes, forward)
    items: dict[str | tuple[str, int], _Item] = {box.name: _Item(box.height, i) for i, box in enumerate(boxes)}
    by_name = {box.name: box for box in boxes}
    ways = {link: _way(link, column, items) for link in forward}
    joined: set[tuple[str, str | tuple[str, int], str | tuple[str, int]]] = set()
    for link, way in ways.items():
        for a, b in pairwise(way):
            if (link.bundle, a, b) in joined and b != link.consumer:
                continue
            joined.add((link.bundle, a, b))
            start = by_name[link.producer].outputs[link.output] if a == link.producer else 0.0
            end = by_name[link.consumer].inputs[link.input] if b == link.consumer else 0.0
            items[a].links.append((items[b], start, end))
            items[b].links.append((items[a], end, start))
    layers: list[list[_Item]] = [[] for _ in range(max(column.values(), default=-1) + 1)]
    for key, item in items.items():
        layers[column[key] if isinstance(key, str) else key[1]].append(item)
    _arrange(layers)
    top = min((item.top for item in items.values()), default=0.0)
    for item in items.values():
        item.top -= top
    lefts, rights, width = _spread(boxes, column, len(layers), back)
    bottom = max((item.top + item.height for item in items.values()), default=0.0)
    routes: dict[Link, Sequence[Point]] = {}
    for link, way in ways.items():
        routes[link] = _points(link, way, items, by_name, column, lefts, rights)
    lanes: dict[str, int] = {}
    for link in links:
        if link in back:
            lane = lanes.setdefault(link.bundle, len(lanes))
            routes[link] = _back_route(link, lane, items, by_name, column, lefts, rights, bottom)
    return Layout(
        boxes={box.name: (lefts[column[box.name]], items[box.name].top) for box in boxes},
        widths={box.name: rights[column[box.name]] - lefts[column[box.name]] for box in boxes},
        routes=routes,
        back=back,
        width=width,
        height=bottom + (ROW_GAP + LANE_GAP * len(lanes) if lanes else 0.0),
    )


def _columns(boxes: Sequence[Box], links: Sequence[Link]) -> dict[str, int]:
    """Longest path from the left; boxes without inputs then move right, next to their first consumer."""
    column = {box.name: 0 for box in boxes}
    fed = {link.consumer for link in links}
    for box in boxes:  # flow order: producers come first
        for link in links:
            if link.producer == box.name:
                column[link.consumer] = max(column[link.consumer], column[box.name] + 1)
    for box in boxes:
        consumers = [column[link.consumer] for link in links if link.producer == box.name]
        if box.name not in fed and consumers:
            column[box.name] = min(consumers) - 1
    return column


def _way(
    link: Link, column: Mapping[str, int], items: dict[str | tuple[str, int], _Item]
) -> list[str | tuple[str, int]]:
    """The items that a line passes: its producer, a point in every column between, its consumer."""
    way: list[str | tuple[str, int]] = [link.producer]
    for between in range(column[link.producer] + 1, column[link.consumer]):
        key = (link.bundle, between)
        items.setdefault(key, _Item(0.0, len(items)))
        way.append(key)
    return [*way, link.consumer]


def _arrange(layers: Sequence[list[_Item]]) -> None:
    """Orders the items of each column and gives them heights."""
    for layer in layers:
        layer.sort(key=lambda item: item.order)
        _stack(layer, [item.top for item in layer])
    for sweep in range(SWEEPS):
        run = layers if sweep % 2 == 0 else layers[::-1]
        seen: set[int] = set()
        for layer in run:
            wanted = {id(item): _wanted(item, seen) for item in layer}
            layer.sort(key=lambda item: (wanted[id(item)] + item.height / 2, item.order))
            _stack(layer, [wanted[id(item)] for item in layer])
            seen.update(id(item) for item in layer)
    for layer in layers:  # the order is settled: now towards all neighbours
        _stack(layer, [_wanted(item, None) for item in layer])


def _wanted(item: _Item, seen: set[int] | None) -> float:
    """The top at which an item's lines to its neighbours (those in `seen`, if given) would be level on average."""
    tops = [other.top + theirs - own for other, own, theirs in item.links if seen is None or id(other) in seen]
    return sum(tops) / len(tops) if tops else item.top


def _stack(layer: Sequence[_Item], wanted: Sequence[float]) -> None:
    """Tops nearest to `wanted` in the least-squares sense that keep the order and a gap (pool adjacent violators)."""
    offset = 0.0
    pools: list[tuple[float, int]] = []  # mean, count
    offsets: list[float] = []
    for item, want in zip(layer, wanted, strict=True):
        offsets.append(offset)
        pools.append((want - offset, 1))
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            (m1, n1), (m2, n2) = pools.pop(), pools.pop()
            pools.append(((m1 * n1 + m2 * n2) / (n1 + n2), n1 + n2))
        offset += item.height + ROW_GAP
    means = [mean for mean, count in pools for _ in range(count)]
    for item, mean, own in zip(layer, means, offsets, strict=True):
        item.top = mean + own


def _spread(
    boxes: Sequence[Box], column: Mapping[str, int], count: int, back: frozenset[Link]
) -> tuple[list[float], list[float], float]:
    """Left and right edge of every column, and the whole width; lines that run back get room beside the boxes."""
    out = [len({link.bundle for link in back if column[link.producer] == c}) for c in range(count)]
    into = [len({link.bundle for link in back if column[link.consumer] == c}) for c in range(count)]
    lefts, rights, x = [], [], 0.0
    for c in range(count):
        inside = [box for box in boxes if column[box.name] == c]
        x += LANE_GAP * into[c]
        lefts.append(x)
        x += max((box.width for box in inside), default=0.0)
        rights.append(x)
        x += LANE_GAP * out[c] + max((box.room for box in inside), default=0.0)
        if c + 1 < count:
            x += COLUMN_GAP
    return lefts, rights, x


def _points(
    link: Link,
    way: Sequence[str | tuple[str, int]],
    items: Mapping[str | tuple[str, int], _Item],
    boxes: Mapping[str, Box],
    column: Mapping[str, int],
    lefts: Sequence[float],
    rights: Sequence[float],
) -> list[Point]:
    start = items[link.producer].top + boxes[link.producer].outputs[link.output]
    points = [
        (rights[column[link.producer]], start),
        (rights[column[link.producer]] + boxes[link.producer].room, start),
    ]
    for key in way[1:-1]:
        assert not isinstance(key, str)
        points += [(lefts[key[1]], items[key].top), (rights[key[1]], items[key].top)]
    return [*points, (lefts[column[link.consumer]], items[link.consumer].top + boxes[link.consumer].inputs[link.input])]


def _back_route(
    link: Link,
    lane: int,
    items: Mapping[str | tuple[str, int], _Item],
    boxes: Mapping[str, Box],
    column: Mapping[str, int],
    lefts: Sequence[float],
    rights: Sequence[float],
    bottom: float,
) -> list[Point]:
    producer = boxes[link.producer]
    start = (rights[column[link.producer]], items[link.producer].top + producer.outputs[link.output])
    end = (lefts[column[link.consumer]], items[link.consumer].top + boxes[link.consumer].inputs[link.input])
    right = start[0] + producer.room + LANE_GAP * (lane + 0.5)
    left = end[0] - LANE_GAP * (lane + 1.2)
    level = bottom + ROW_GAP * 0.6 + LANE_GAP * lane
    return [start, (right, start[1]), (right, level), (left, level), (left, end[1]), end]
