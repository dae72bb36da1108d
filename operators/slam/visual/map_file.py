"""Saved visual maps: keyframes with the features and the surface that each saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from operators.odometry.rgbd.surface import Surface
from operators.slam.keyframe_graph import Node
from operators.slam.map_file import ends, joined, read_map, write_map
from operators.slam.visual.graph import VisualGraph
from operators.slam.visual.view import View

VERSION = 1


def write_visual_map(graph: VisualGraph, path: Path) -> None:
    """Writes the views of a graph whose place in the map is known. The same map gives the same bytes."""
    write_map(graph, path, VERSION, _packed)


def read_visual_map(path: Path) -> list[Node[View]]:
    """Returns the nodes of a saved map. Raises ValueError for a file that is none."""
    return read_map(path, "visual", VERSION, _views)


def _packed(views: Sequence[View]) -> dict[str, Any]:
    return {
        "features": np.array([len(view.pixels) for view in views], np.int64),
        "pixels": joined([view.pixels for view in views], (0, 2), np.float32),
        "descriptors": joined([view.descriptors for view in views], (0, 128), np.uint8),
        "points": joined([view.points for view in views], (0, 3), np.float32),
        "shaded": np.array([len(view.shades) for view in views], np.int64),
        "shades": joined([view.shades for view in views], (0,), np.uint8),
        "surface_shapes": np.array([view.surface.inverse_depth.shape for view in views], np.int64).reshape(-1, 2),
        "surface_K": np.array([view.surface.K for view in views]).reshape(-1, 3, 3),
        "surfaces": joined([view.surface.inverse_depth.ravel() for view in views], (0,), np.float32),
    }


def _views(a: Mapping[str, Any]) -> list[View]:
    features, shaded = ends(a["features"]), ends(a["shaded"])
    cells = ends(a["surface_shapes"].prod(axis=1))
    views = []
    for k in range(len(a["features"])):
        here, shades, patch = (slice(parts[k], parts[k + 1]) for parts in (features, shaded, cells))
        surface = Surface(a["surfaces"][patch].reshape(a["surface_shapes"][k]), a["surface_K"][k])
        views.append(View(a["pixels"][here], a["descriptors"][here], a["points"][here], surface, a["shades"][shades]))
    return views
