"""Scene graphs: objects as labelled boxes, agents as capsules, intentions as arrows; a tree and a list in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import Activity, SceneGraph
from dataflow.messages.geometry import quaternion_to_matrix
from dataflow.messages.scene_summary import (
    Row,
    SceneSummary,
    SummaryRelation,
    agents_in_words,
    carriers_in_words,
    class_names,
    doing,
    movers_in_words,
    percent,
    rooms_in_words,
    spaced,
    summarize,
)
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.visualizers.clouds import finite_rows
from dataflow.view.visualizers.scene_tree import tree, with_act

_LINE = (125, 130, 140)
_PLACE = (80, 95, 110)
_INTENTION = (255, 205, 70)
_RELATION = (235, 235, 235)
_STILL = 0.02  # metres: a box that moved by less is not drawn again
_GOALS = 3  # of an agent, the likeliest
_LIKELY = 0.1  # goals that are less probable are not drawn
_SHEET = 0.05  # metres: half the thickness up to which a place is a wall
_THIN = 0.05  # metres: least radius of a capsule


@visualizer(SceneGraph, "graph", "space", "text")
def scene_graph(canvas: Canvas, message: SceneGraph) -> None:
    """Objects in space, a tree and a list of those relations that are worth showing."""
    activities = canvas.scene.remembered.get((_operator(canvas.stream), "activities"))
    told = summarize(message, activities)
    tree(canvas, message, told, activities)
    _words(canvas, message, told, activities)
    shown = finite_rows(message.positions, message.sizes)
    _places(canvas, message, [i for i in shown if i in told.places and message.sizes[i].any()])
    solid = [i for i in shown if i not in told.places | told.agents and message.sizes[i].any()]
    acting = [r for r in (*told.intentions, *told.telling) if r.subject in told.agents]
    named = {r.object for r in acting} | {r.subject for r in acting}
    carried = {i for i, r in told.carriers.items() if r.object not in told.places}
    _boxes(canvas, "space/things", message, [i for i in solid if i not in carried or i in named], True)
    _boxes(canvas, "space/parts", message, [i for i in solid if i in carried and i not in named], False)
    _agents(canvas, message, [i for i in shown if i in told.agents], activities)
    drawable = set(shown.tolist())
    _lines(canvas, message, told, drawable)
    _intentions(canvas, message, [r for r in told.intentions if {r.subject, r.object} <= drawable])


@visualizer(Activity, "log")
def activity(canvas: Canvas, message: Activity) -> None:
    """A line of text whenever a subject's activity or goal changes; its operator's scene graph shows it, too."""
    canvas.scene.remembered[_operator(canvas.stream), "activities"] = message
    for i, (subject, (name, score)) in enumerate(doing(message).items()):
        goal = message.goals[i] if message.goals else ""
        target = int(message.objects[i]) if message.objects is not None and message.objects[i] >= 0 else None
        if canvas.scene.changed(canvas.entity, f"activity {subject}", (name, goal.partition(" (")[0], target)):
            canvas.text(
                f"#{subject} {spaced(name)} {score:.2f}"
                + (f", object #{target}" if target is not None else "")
                + (f", goal: {goal}" if goal else "")
            )


def _operator(stream: str) -> str:
    return stream.rpartition("/")[0]


def _words(canvas: Canvas, message: SceneGraph, told: SceneSummary, activities: Activity | None) -> None:
    """The graph as a list in Markdown, sent where it differs from the last."""
    tables = (
        _table("who", "does", agents_in_words(message, told, activities)),
        _table("what", "moves", movers_in_words(message, told, activities)),
        _table("room", "has", rooms_in_words(message, told)),
        _table("what", "carries", carriers_in_words(message, told)),
    )
    counted = f"{message.count} nodes, {len(message.subjects)} relations"
    text = "\n\n".join((*filter(None, tables), counted))
    if canvas.scene.changed(canvas.entity, "words", text):
        canvas.log("text", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _table(first: str, second: str, rows: Sequence[Row]) -> str:
    """A table in Markdown; nothing without rows."""
    lines = (f"| **{row.name}** | {row.text} |" for row in rows)
    return "\n".join((f"| {first} | {second} |\n|---|---|", *lines)) if rows else ""


def _places(canvas: Canvas, message: SceneGraph, places: Sequence[int]) -> None:
    """The outline of each place: of a room or floor on its ground, of a wall upright."""
    outlines = []
    for i in places:
        half = message.sizes[i] / 2
        around = np.array([(x, y, -1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))])
        thin = int(np.argmin(half))
        corners = (around if thin == 2 or half[thin] > _SHEET else np.roll(around, thin + 1, axis=1)) * half
        axes = np.eye(3) if message.orientations is None else quaternion_to_matrix(message.orientations[i])
        outlines.append(corners @ axes.T + message.positions[i])
    if not _moved(canvas, "places", outlines):
        return
    names = message.names()
    lines = rr.LineStrips3D(
        outlines, colors=_PLACE, radii=rr.Radius.ui_points(0.6), labels=[names[i] for i in places], show_labels=False
    )
    canvas.draw("space/places", message.frame, lines)


def _boxes(canvas: Canvas, path: str, message: SceneGraph, nodes: Sequence[int], labelled: bool) -> None:
    chosen = np.asarray(nodes, np.int64)
    now = np.column_stack([message.positions, message.sizes])[chosen]
    turned = None if message.orientations is None else message.orientations[chosen]
    rows = [*message.ids[chosen, None], now, *([] if turned is None else [turned])]
    if not _moved(canvas, path, rows):
        return
    names, classes = message.names(), class_names(message)
    boxes = rr.Boxes3D(
        centers=message.positions[chosen],
        half_sizes=message.sizes[chosen] / 2,
        quaternions=turned,
        colors=colors.of_classes([classes[i] for i in chosen]),
        labels=[names[i] for i in chosen],
        show_labels=labelled,
        radii=rr.Radius.ui_points(1.5 if labelled else 1.0),
    )
    canvas.draw(path, message.frame, boxes)


def _agents(canvas: Canvas, message: SceneGraph, agents: Sequence[int], activities: Activity | None) -> None:
    """Capsules as tall as the agents, with what they do."""
    names, acts = message.names(), doing(activities)
    chosen = np.asarray(agents, np.int64)
    sizes = np.maximum(message.sizes[chosen], 2 * _THIN)
    radii = np.minimum(sizes[:, :2].mean(axis=1), sizes[:, 2]) / 2
    bottoms = message.positions[chosen] - np.column_stack([np.zeros((len(chosen), 2)), sizes[:, 2] / 2 - radii])
    capsules = rr.Capsules3D(
        lengths=sizes[:, 2] - 2 * radii,
        radii=radii,
        translations=bottoms,
        colors=colors.AGENT,
        fill_mode=rr.components.FillMode.Solid,
        labels=[with_act(names[i], acts.get(int(message.ids[i]))) for i in chosen],
        show_labels=True,
    )
    canvas.draw("space/agents", message.frame, capsules)


def _lines(canvas: Canvas, message: SceneGraph, told: SceneSummary, drawable: set[int]) -> None:
    """Thin lines from each thing to what carries it, thicker ones with words for other relations."""
    carried = [r for r in told.carriers.values() if r.object not in told.places and {r.subject, r.object} <= drawable]
    ends = [message.positions[[r.subject, r.object]] for r in carried]
    if _moved(canvas, "carried", ends):
        lines = rr.LineStrips3D(ends, colors=_LINE, radii=rr.Radius.ui_points(0.7))
        canvas.draw("space/carried", message.frame, lines)
    others = [r for r in told.telling if {r.subject, r.object} <= drawable and r.subject in told.agents]
    ends = [message.positions[[r.subject, r.object]] for r in others]
    words = [spaced(r.predicate) for r in others]
    if _moved(canvas, "relations", ends) | canvas.scene.changed(canvas.entity, "words of relations", words):
        lines = rr.LineStrips3D(ends, colors=_RELATION, radii=rr.Radius.ui_points(1.5), labels=words, show_labels=True)
        canvas.draw("space/relations", message.frame, lines)


def _intentions(canvas: Canvas, message: SceneGraph, intentions: Sequence[SummaryRelation]) -> None:
    """An arrow from each agent to its likeliest goals, the brighter the likelier, with the probability."""
    likely: list[SummaryRelation] = []
    for r in intentions:
        if r.score >= _LIKELY and sum(other.subject == r.subject for other in likely) < _GOALS:
            likely.append(r)
    starts = message.positions[[r.subject for r in likely]].reshape(-1, 3)
    ends = message.positions[[r.object for r in likely]].reshape(-1, 3)
    arrows = rr.Arrows3D(
        origins=starts,
        vectors=ends - starts,
        colors=[(*_INTENTION, round(80 + 175 * r.score)) for r in likely],
        radii=rr.Radius.ui_points([1.0 + 2.5 * r.score for r in likely]),
        labels=[percent(r.score) for r in likely],
        show_labels=True,
    )
    canvas.draw("space/intentions", message.frame, arrows)


def _moved(canvas: Canvas, what: str, arrays: Sequence[npt.NDArray[np.float64]]) -> bool:
    """Returns whether what is drawn differs from the last drawing by more than can be seen."""
    cells = tuple(tuple(np.round(np.asarray(a, np.float64) / _STILL).ravel().tolist()) for a in arrays)
    return canvas.scene.changed(canvas.entity, what, cells)
