"""The meaning of a scene: the scene graph, activities, embeddings."""

from __future__ import annotations

import numpy as np
import rerun as rr

from dataflow.messages import Activity, Classification, FeatureVector, SceneGraph
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.visualizers.clouds import finite_rows
from dataflow.view.visualizers.objects import MANY_LABELS

_RELATION = (120, 125, 135)


@visualizer(SceneGraph, "graph", "space")
def scene_graph(canvas: Canvas, message: SceneGraph) -> None:
    """A graph of objects and relations, and the same objects as boxes in space joined by lines."""
    names = message.names()
    classes = [message.class_names[c] if message.class_names else str(c) for c in message.class_ids.tolist()]
    paint = colors.of_classes(classes)
    relations = message.relations()
    keys = [f"n{i}" for i in message.ids.tolist()]
    predicates = [f"{keys[s]} {p} {keys[o]}" for s, p, o in relations]
    canvas.log(
        "graph",
        rr.GraphNodes(
            node_ids=[*keys, *dict.fromkeys(predicates)],
            labels=[*names, *(dict(zip(predicates, (p for _, p, _ in relations), strict=True)).values())],
            colors=np.vstack([paint, np.tile(np.array(_RELATION, np.uint8), (len(dict.fromkeys(predicates)), 1))]),
            radii=[8.0] * len(keys) + [3.0] * len(dict.fromkeys(predicates)),
            show_labels=True,
        ),
        rr.GraphEdges(
            [
                edge
                for key, (s, _, o) in dict(zip(predicates, relations, strict=True)).items()
                for edge in ((keys[s], key), (key, keys[o]))
            ],
            graph_type="directed",
        ),
    )
    shown = finite_rows(message.positions, message.sizes)
    canvas.draw(
        "space",
        message.frame,
        rr.Boxes3D(
            centers=message.positions[shown],
            half_sizes=message.sizes[shown] / 2,
            quaternions=None if message.orientations is None else message.orientations[shown],
            colors=paint[shown],
            labels=[names[i] for i in shown],
            show_labels=len(shown) <= MANY_LABELS,
        ),
    )
    drawable = set(shown.tolist())
    canvas.draw(
        "space/relations",
        message.frame,
        rr.LineStrips3D(
            [message.positions[[s, o]] for s, _, o in relations if s in drawable and o in drawable],
            colors=_RELATION,
            labels=[p for s, p, o in relations if s in drawable and o in drawable],
            show_labels=len(relations) <= MANY_LABELS,
            radii=rr.Radius.ui_points(1.0),
        ),
    )


@visualizer(Activity, "log")
def activity(canvas: Canvas, message: Activity) -> None:
    """A line of text whenever a subject's activity or goal changes."""
    for i, subject in enumerate(message.subjects.tolist()):
        name = message.class_names[message.class_ids[i]] if message.class_names else str(message.class_ids[i])
        goal = message.goals[i] if message.goals else ""
        target = int(message.objects[i]) if message.objects is not None and message.objects[i] >= 0 else None
        if canvas.scene.changed(canvas.entity, f"activity {subject}", (name, goal, target)):
            canvas.text(
                f"#{subject} {name} {message.scores[i]:.2f}"
                + (f", object #{target}" if target is not None else "")
                + (f", goal: {goal}" if goal else "")
            )


@visualizer(Classification, "status", "log")
def classification(canvas: Canvas, message: Classification) -> None:
    """A lane of classes over time for the image or for each object, and a line of text whenever a class changes."""
    ids = [None] * len(message.class_ids) if message.ids is None else message.ids.tolist()
    for identity, name, score in zip(ids, message.labels(), message.scores.tolist(), strict=True):
        subject = "image" if identity is None else f"object {identity}"
        if canvas.scene.changed(canvas.entity, f"class {subject}", name):
            canvas.log(f"status/{rr.escape_entity_path_part(subject)}", rr.StateChange(state=name))
            canvas.text(f"{subject}: {name} {score:.2f}")


@visualizer(FeatureVector, "tensor")
def feature_vector(canvas: Canvas, message: FeatureVector) -> None:
    """The vectors as rows of an image."""
    if message.vectors.size == 0:
        canvas.clear("tensor")
        return
    canvas.log("tensor", rr.Tensor(message.vectors, dim_names=["vector", "dimension"]))
