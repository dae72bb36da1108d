"""Scene graphs as Spark-DSG reads them, the library of Hydra and its tools (https://github.com/MIT-SPARK/Spark-DSG).

Its JSON needs nothing of that library to write: nodes with attributes in layers, and edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dataflow.messages import SceneGraph
from dataflow.messages.scene_summary import ROOMS
from operators.scene.relations import FLOOR, ROBOT, ROOM, SURFACE

_HEADER = {"project_name": "main", "version": {"major": 1, "minor": 1, "patch": 3}}
_OBJECTS, _SURFACES, _ROOMS, _BUILDINGS = 2, 3, 4, 5
_LAYERS = {"OBJECTS": 2, "AGENTS": 2, "SURFACES": 3, "ROOMS": 4, "BUILDINGS": 5}


def as_spark_dsg(graph: SceneGraph) -> dict[str, Any]:
    """Returns a graph as the content of a file that `spark_dsg.DynamicSceneGraph.load` opens.

    The room is in layer ROOMS and the parent of everything; where there are several, they are the parents of what is in
    them, and the building, in layer BUILDINGS, is that of all else. Floor, walls and table tops are in layer SURFACES,
    objects, agents and robot in layer OBJECTS. All have upright boxes, labels by the graph's classes, and score and id
    as metadata. There is one edge for two nodes: its weight is the greatest score of their relations, which its
    metadata name.
    """
    names = graph.names()
    yaws = graph.orientations if graph.orientations is not None else np.tile([0.0, 0, 0, 1], (graph.count, 1))
    symbols = [_symbol(i) for i in graph.ids.tolist()]
    nodes = [_node(graph, k, names[k], symbols[k], yaws[k]) for k in range(graph.count)]
    edges: dict[tuple[int, int], dict[str, float]] = {}
    scores = graph.relation_scores
    for k, (s, predicate, o) in enumerate(graph.relations()):
        held = edges.setdefault((min(s, o), max(s, o)), {})
        held[f"{names[s]} {predicate} {names[o]}"] = 1.0 if scores is None else round(float(scores[k]), 4)
    ids = graph.ids.tolist()
    within = {s for s, p, o in graph.relations() if p == "in" and ids[o] < ROOMS}
    for room in [k for k, i in enumerate(ids) if i == ROOM]:
        for k in range(graph.count):
            if k != room and k not in within:
                edges.setdefault((min(k, room), max(k, room)), {})
    labels = [[k, name] for k, name in enumerate(graph.class_names)]
    return {
        "SPARK_DSG_header": _HEADER,
        "directed": False,
        "multigraph": False,
        "layer_keys": [{"layer": layer, "partition": 0} for layer in (2, 3, 4, 5)],
        "layer_names": {name: {"layer": layer, "partition": 0} for name, layer in _LAYERS.items()},
        "metadata": {
            "frame": graph.frame,
            "stamp": graph.stamp,
            "labelspaces": {f"_l{layer}p0": labels for layer in (_OBJECTS, _SURFACES, _ROOMS)},
        },
        "nodes": nodes,
        "edges": [
            {
                "source": symbols[a],
                "target": symbols[b],
                "info": {
                    "type": "EdgeAttributes",
                    "weighted": bool(held),
                    "weight": max(held.values(), default=1.0),
                    "metadata": {"relations": held},
                },
            }
            for (a, b), held in edges.items()
        ],
    }


def _is_surface(id: int) -> bool:
    return id == FLOOR or ROOMS <= id < SURFACE


def _symbol(id: int) -> int:
    """Returns the id that Spark-DSG writes as a letter and a number."""
    if _is_surface(id):
        return (ord("s") << 56) | (0 if id == FLOOR else SURFACE - id)
    if id < ROOMS:
        return (ord("R") << 56) | (ROOMS - id)
    return (ord("R" if id == ROOM else "a" if id == ROBOT else "O") << 56) | max(id, 0)


def _node(graph: SceneGraph, k: int, name: str, symbol: int, orientation: Any) -> dict[str, Any]:
    id = int(graph.ids[k])
    room = id == ROOM or id < ROOMS
    place, size = graph.positions[k].tolist(), graph.sizes[k].tolist()
    x, y, z, w = (float(v) for v in orientation)
    turn = {"w": w, "x": x, "y": y, "z": z}
    metadata = {"id": int(graph.ids[k])}
    more = {} if graph.scores is None else {"score": round(float(graph.scores[k]), 4)}
    attributes: dict[str, Any] = {
        "type": "RoomNodeAttributes" if room else "ObjectNodeAttributes",
        "name": name,
        "position": place,
        "bounding_box": {"type": "RAABB", "dimensions": size, "world_P_center": place, "world_R_center": turn},
        "color": {"r": 120, "g": 120, "b": 120, "a": 255},
        "is_active": False,
        "is_predicted": False,
        "last_update_time_ns": graph.stamp if graph.last_seen is None else int(graph.last_seen[k]),
        "metadata": metadata | more,
        "semantic_label": int(graph.class_ids[k]),
        "semantic_feature": {"rows": 0, "cols": 0, "data": None},
    }
    own = (
        {"semantic_class_probabilities": {}}
        if room
        else {"mesh_connections": [], "registered": False, "world_R_object": turn}
    )
    layer = _ROOMS if room else _SURFACES if _is_surface(id) else _OBJECTS
    layer = _BUILDINGS if id == ROOM and graph.areas is not None else layer
    return {"id": symbol, "layer": layer, "partition": 0, "attributes": attributes | own}
