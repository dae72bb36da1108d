"""Objects in space, the map of what is where, and the graph of how things relate."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.scene.object_lifter import ObjectLifter
    from operators.scene.scene_graph_builder import SceneGraphBuilder
    from operators.scene.semantic_map import SemanticMap
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "object_lifter": ("ObjectLifter",),
            "scene_graph_builder": ("SceneGraphBuilder",),
            "semantic_map": ("SemanticMap",),
        },
    )

__all__ = [
    "ObjectLifter",
    "SceneGraphBuilder",
    "SemanticMap",
]
