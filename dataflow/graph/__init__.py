"""The graph language: YAML that names operators and wires them; loaded, resolved and checked before anything starts."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from dataflow.graph.load import load_bundle, load_graph, load_text
    from dataflow.graph.model import Edge, Graph, Live, Node, OperatorImportError, Placement, Stream
    from dataflow.graph.problems import GraphError, Place, Problem
    from dataflow.graph.sections import Network
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "load": ("load_bundle", "load_graph", "load_text"),
            "model": ("Edge", "Graph", "Live", "Node", "OperatorImportError", "Placement", "Stream"),
            "sections": ("Network",),
            "problems": ("GraphError", "Place", "Problem"),
        },
    )

__all__ = [
    "Edge",
    "Graph",
    "GraphError",
    "Live",
    "Network",
    "Node",
    "OperatorImportError",
    "Place",
    "Placement",
    "Problem",
    "Stream",
    "load_bundle",
    "load_graph",
    "load_text",
]
