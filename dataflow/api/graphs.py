"""Graphs as functions take them: built in Python, checked already, or the path of a YAML file."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dataflow.graph import Graph as ResolvedGraph
from dataflow.graph import load_graph


class GraphBuilder(ABC):
    """Something under construction that gives a checked graph."""

    @abstractmethod
    def build(self, settings: Mapping[str, Any] | None = None) -> ResolvedGraph:
        """Builds the graph, checked wholly; `settings` change parameters. Raises `GraphError`."""


GraphLike = GraphBuilder | ResolvedGraph | str | Path


def resolved(graph: GraphLike, settings: Mapping[str, Any] | None = None) -> ResolvedGraph:
    """The checked graph of a builder or a YAML file. Raises `GraphError`; `ValueError` for settings without a file."""
    if isinstance(graph, str | Path):
        return load_graph(graph, settings=words(settings))
    if settings:
        raise ValueError("settings change a graph file; give parameters to Graph.add()")
    return graph.build() if isinstance(graph, GraphBuilder) else graph


def words(settings: Mapping[str, Any] | None) -> list[str]:
    """Settings as the command line has them."""
    return [
        f"{name}={v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)}"
        for name, v in (settings or {}).items()
    ]
