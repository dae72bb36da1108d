"""Memory of a visual map, as plain values that an operator's snapshot and a map file may hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from operators.odometry.surface import Surface
from operators.slam.pose_graph import Edge
from operators.slam.visual_graph import Node, Surprise, VisualGraph
from operators.slam.visual_view import Sight, View


def graph_to_plain(graph: VisualGraph) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `graph_from_plain` is the inverse."""
    return {
        "nodes": [node_to_plain(node) for node in graph.nodes],
        "edges": [_plain(edge) for edge in graph.edges],
        "T_map_odom": graph.T_map_odom,
        "fixed": graph.fixed,
        "tied": sorted(graph.tied),
        "surprises": [_plain(s) | {"seen": _plain(s.seen)} for s in graph.surprises],
        "segments": [[segment, island] for segment, island in sorted(graph.segments.items())],
    }


def graph_from_plain(graph: VisualGraph, values: Mapping[str, Any]) -> None:
    """Fills an empty graph of the same settings."""
    graph.take([node_from_plain(node) for node in values["nodes"]], int(values["fixed"]))
    graph.edges = [Edge(**edge) for edge in values["edges"]]
    graph.T_map_odom = np.array(values["T_map_odom"], np.float64)
    graph.tied = {int(island) for island in values["tied"]}
    graph.surprises = [Surprise(**(s | {"seen": Sight(**s["seen"])})) for s in values["surprises"]]
    graph.segments = {int(segment): int(island) for segment, island in values["segments"]}


def node_to_plain(node: Node) -> dict[str, Any]:
    view = node.view
    kept = None if view is None else _plain(view) | {"surface": _plain(view.surface)}
    return _plain(node) | {"view": kept}


def node_from_plain(values: Mapping[str, Any]) -> Node:
    view = values["view"]
    kept = None if view is None else View(**(dict(view) | {"surface": Surface(**view["surface"])}))
    return Node(**(dict(values) | {"view": kept}))


def _plain(value: Node | View | Surface | Edge | Sight | Surprise) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}
