"""Memory of a map of places, as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

from operators.slam.keyframe_graph import Node
from operators.slam.place_graph import PlaceGraph
from operators.slam.pose_graph import Edge
from operators.slam.sensor_model import Surprise

V = TypeVar("V")


def graph_to_plain(graph: PlaceGraph[V], view_to_plain: Callable[[V], dict[str, Any]]) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `graph_from_plain` is the inverse."""
    return {
        "nodes": [[k, _node_to_plain(node, view_to_plain)] for k, node in graph.nodes.items()],
        "edges": [plain(edge) for edge in graph.graph.edges],
        "fixed": sorted(graph.graph.fixed),
        "T_map_odom": graph.T_map_odom,
        "tied": sorted(graph.tied),
        "islands": graph.islands,
        "segments": [[segment, island] for segment, island in graph.segments.items()],
        "surprises": [plain(s) for s in graph.surprises],
        "loops": graph.loops,
    }


def graph_from_plain(
    graph: PlaceGraph[V], values: Mapping[str, Any], view_from_plain: Callable[[Mapping[str, Any]], V]
) -> None:
    """Fills an empty graph of the same settings."""
    graph.graph.nodes = {int(k): _node_from_plain(node, view_from_plain) for k, node in values["nodes"]}
    graph.graph.edges = [Edge(**edge) for edge in values["edges"]]
    graph.graph.fixed = {int(k) for k in values["fixed"]}
    graph.T_map_odom = np.array(values["T_map_odom"], np.float64)
    graph.tied = {int(island) for island in values["tied"]}
    graph.islands = int(values["islands"])
    graph.segments = {int(segment): int(island) for segment, island in values["segments"]}
    graph.surprises = [Surprise(**s) for s in values["surprises"]]
    graph.loops = int(values["loops"])
    graph.index_views()


def _node_to_plain(node: Node[V], view_to_plain: Callable[[V], dict[str, Any]]) -> dict[str, Any]:
    return plain(node) | {"view": None if node.view is None else view_to_plain(node.view)}


def _node_from_plain(values: Mapping[str, Any], view_from_plain: Callable[[Mapping[str, Any]], V]) -> Node[V]:
    view = values["view"]
    return Node(**(dict(values) | {"view": None if view is None else view_from_plain(view)}))


def plain(value: Any) -> dict[str, Any]:
    """Returns the fields of a dataclass."""
    return {field.name: getattr(value, field.name) for field in fields(value)}
