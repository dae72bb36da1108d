"""Objects in space, the map of what is where, and the graph of how things relate."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.scene.graph.builder import SceneGraphBuilder
    from operators.scene.lifting.object_lifter import ObjectLifter
    from operators.scene.map.semantic_map import SemanticMap
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "lifting.object_lifter": ("ObjectLifter",),
            "graph.builder": ("SceneGraphBuilder",),
            "map.semantic_map": ("SemanticMap",),
        },
    )

__all__ = ["ObjectLifter", "SceneGraphBuilder", "SemanticMap"]
