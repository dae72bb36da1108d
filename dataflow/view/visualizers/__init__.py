"""One visualiser per message type, one module per family; importing this package registers them all."""

from dataflow.view.visualizers import (
    cameras,
    clouds,
    fallback,
    maps,
    objects,
    poses,
    ranging,
    scene_graphs,
    semantics,
    status,
    values,
)

__all__ = [
    "cameras",
    "clouds",
    "fallback",
    "maps",
    "objects",
    "poses",
    "ranging",
    "scene_graphs",
    "semantics",
    "status",
    "values",
]
