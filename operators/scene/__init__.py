"""Objects in space, the map of what is where, and the graph of how things relate."""

from operators.scene.object_lifter import ObjectLifter
from operators.scene.scene_graph_builder import SceneGraphBuilder
from operators.scene.semantic_map import SemanticMap

__all__ = ["ObjectLifter", "SceneGraphBuilder", "SemanticMap"]
