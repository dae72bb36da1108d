"""Memory of a visual map, as plain values that an operator's snapshot and a map file may hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from operators.odometry.surface import Surface
from operators.slam.keyframe_graph import Node
from operators.slam.pose_graph import Edge
from operators.slam.visual_graph import Surprise, VisualGraph
from operators.slam.visual_view import View


def graph_to_plain(graph: VisualGraph) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `graph_from_plain` is the inverse."""
    return {
        "nodes": [[k, node_to_plain(node)] for k, node in graph.nodes.items()],
        "edges": [_plain(edge) for edge in graph.graph.edges],
        "fixed": sorted(graph.graph.fixed),
        "T_map_odom": graph.T_map_odom,
        "tied": sorted(graph.tied),
        "islands": graph.islands,
        "segments": [[segment, island] for segment, island in graph.segments.items()],
        "surprises": [_plain(s) for s in graph.surprises],
        "loops": graph.loops,
    }


def graph_from_plain(graph: VisualGraph, values: Mapping[str, Any]) -> None:
    """Fills an empty graph of the same settings."""
    graph.graph.nodes = {int(k): node_from_plain(node) for k, node in values["nodes"]}
    graph.graph.edges = [Edge(**edge) for edge in values["edges"]]
    graph.graph.fixed = {int(k) for k in values["fixed"]}
    graph.T_map_odom = np.array(values["T_map_odom"], np.float64)
    graph.tied = {int(island) for island in values["tied"]}
    graph.islands = int(values["islands"])
    graph.segments = {int(segment): int(island) for segment, island in values["segments"]}
    graph.surprises = [Surprise(**s) for s in values["surprises"]]
    graph.loops = int(values["loops"])
    graph.index_views()


def node_to_plain(node: Node) -> dict[str, Any]:
    view = node.view
    kept = None if view is None else _plain(view) | {"surface": _plain(view.surface)}
    return _plain(node) | {"view": kept}


def node_from_plain(values: Mapping[str, Any]) -> Node:
    view = values["view"]
    kept = None if view is None else View(**(dict(view) | {"surface": Surface(**view["surface"])}))
    return Node(**(dict(values) | {"view": kept}))


def _plain(value: Node | View | Surface | Edge | Surprise) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}
