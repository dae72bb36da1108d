"""One visualiser per message type, one module per family; importing this package registers them all."""

from dataflow.view.visualizers import cameras, clouds, maps, objects, poses, scene_graphs, status, values

__all__ = ["cameras", "clouds", "maps", "objects", "poses", "scene_graphs", "status", "values"]
