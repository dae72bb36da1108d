"""Objects in space, the map of what is where, and the graph of how things relate."""

from operators.scene.object_lifter import ObjectLifter

__all__ = ["ObjectLifter"]
