"""The node-link view of a scene graph: who does what with what, and what carries what, in columns that stay in view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from dataflow.messages import Activity, SceneGraph
from dataflow.messages.scene_summary import SceneSummary, SummaryRelation, class_names, doing, grouped, percent
from dataflow.messages.scene_summary import spaced as words_of
from dataflow.view import colors
from dataflow.view.canvas import Canvas

WIDTH, HEIGHT = 1250.0, 300.0
"""Extent of the picture in the view's own units: the same at all times, so that the view never has to be moved."""

_ROWS = 9
"""Rows of a block; carriers that do not fit go into the next block, to the right."""
_BLOCKS = 3
_AGENTS = 0.36  # of the width: agents and what they do, in front of the blocks
_WAYS = 3  # relations of an agent
_WORD = (150, 155, 165)


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the picture. `x` and `y` are shares of its extent."""

    key: str
    label: str
    color: colors.RGB
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True, slots=True)
class Block:
    """A carrier and what it carries, several of a class as one."""

    carrier: Node
    carried: tuple[Node, ...]

    @property
    def rows(self) -> int:
        return max(1, len(self.carried))


def tree(canvas: Canvas, message: SceneGraph, told: SceneSummary, activities: Activity | None) -> None:
    """Draws agents at the left, what they do with what beside them, and what carries what further right."""
    nodes, edges = arranged(message, told, activities)
    if not canvas.scene.changed(canvas.entity, "tree", (tuple(nodes), tuple(edges))):
        return
    drawn = rr.GraphNodes(
        node_ids=[n.key for n in nodes],
        positions=[(n.x * WIDTH, n.y * HEIGHT) for n in nodes],
        labels=[n.label for n in nodes],
        colors=np.array([n.color for n in nodes], np.uint8).reshape(-1, 3),
        show_labels=True,
    )
    canvas.log("graph", drawn, rr.GraphEdges(edges, graph_type="directed"))


def arranged(
    message: SceneGraph, told: SceneSummary, activities: Activity | None
) -> tuple[list[Node], list[tuple[str, str]]]:
    """Returns the nodes in their places, and the edges between them by key."""
    blocks = _in_columns(_blocks(message, told))
    nodes = [node for block in blocks for node in (block.carrier, *block.carried)]
    edges = [(block.carrier.key, node.key) for block in blocks for node in block.carried]
    more, links = _agents(message, told, activities)
    return nodes + more, edges + links


def _blocks(message: SceneGraph, told: SceneSummary) -> list[Block]:
    names, classes = message.names(), class_names(message)
    blocks = []
    for node in range(message.count):
        children = [c for c in told.carried(node) if c not in told.agents]
        if node in told.agents | told.places or not children:
            continue
        key, kinds, carried = _key(message, node), dict[str, list[int]](), []
        for child in children:
            kinds.setdefault(classes[child], []).append(child)
        for kind, several in sorted(kinds.items(), key=lambda entry: -len(entry[1])):
            label = grouped([names[c] for c in several], [kind] * len(several))
            own = _key(message, several[0]) if len(several) == 1 else f"{key} {kind}"
            carried.append(Node(own, label, colors.of_class(kind)))
        blocks.append(Block(Node(key, names[node], colors.of_class(classes[node])), tuple(carried)))
    return blocks


def _in_columns(blocks: list[Block]) -> list[Block]:
    """The blocks in their places: as many columns as they need, rows as high as there is room for."""
    total = sum(block.rows for block in blocks)
    count = min(_BLOCKS, max(1, -(-total // _ROWS)))
    most = max(_ROWS, -(-total // count) + 1)
    columns: list[list[Block]] = [[]]
    for block in blocks:
        full = sum(b.rows for b in columns[-1]) + block.rows > most
        if full and columns[-1] and len(columns) < _BLOCKS:
            columns.append([])
        columns[-1].append(block)
    rows = max(_ROWS, max(sum(b.rows for b in column) for column in columns))
    width = (1 - _AGENTS) / max(len(columns), 2)
    placed = []
    for c, column in enumerate(columns):
        row = 0
        for block in column:
            x, beside = _AGENTS + c * width, _AGENTS + (c + 0.45) * width
            carried = (replace(node, x=beside, y=(row + k + 0.5) / rows) for k, node in enumerate(block.carried))
            placed.append(Block(replace(block.carrier, x=x, y=(row + block.rows / 2) / rows), tuple(carried)))
            row += block.rows
    return placed


def _agents(
    message: SceneGraph, told: SceneSummary, activities: Activity | None
) -> tuple[list[Node], list[tuple[str, str]]]:
    """The agents, each with what it does with what; a thing that carries is there twice, so that no lines cross."""
    names, classes, acts = message.names(), class_names(message), doing(activities)
    nodes: list[Node] = []
    edges: list[tuple[str, str]] = []
    agents = sorted(told.agents)
    row = 0.5
    ways = {agent: _ways(agent, told) for agent in agents}
    rows = max(_ROWS, sum(max(1, len(way)) for way in ways.values()))
    for agent in agents:
        key, act = _key(message, agent), acts.get(int(message.ids[agent]))
        nodes.append(Node(key, with_act(names[agent], act), colors.AGENT, 0.0, row / rows))
        for relation in ways[agent]:
            word = words_of(relation.predicate)
            if relation in told.intentions:
                word += f" ({percent(relation.score)})"
            link = f"{key} {relation.predicate} {_key(message, relation.object)}"
            paint = colors.of_class(classes[relation.object])
            nodes.append(Node(link, word, _WORD, 0.13, row / rows))
            nodes.append(Node(f"{link} there", names[relation.object], paint, 0.24, row / rows))
            edges += [(key, link), (link, f"{link} there")]
            row += 1
        row += 0 if ways[agent] else 1
    return nodes, edges


def with_act(name: str, act: tuple[str, float] | None) -> str:
    """The label of an agent: its name, and what it does where that is known."""
    return name if act is None else f"{name}: {words_of(act[0])}"


def _ways(agent: int, told: SceneSummary) -> list[SummaryRelation]:
    """The relations of an agent that are shown."""
    carrier = told.carriers.get(agent)
    related = [] if carrier is None or carrier.object in told.places else [carrier]
    return [*related, *(r for r in (*told.telling, *told.intentions) if r.subject == agent)][:_WAYS]


def _key(message: SceneGraph, node: int) -> str:
    return f"n{message.ids[node]}"
