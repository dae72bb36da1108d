"""Saved visual maps: one NumPy archive (.npz) of the views and where they are."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from operators.odometry.surface import Surface
from operators.slam.keyframe_graph import Node
from operators.slam.visual_graph import VisualGraph
from operators.slam.visual_view import View

VERSION = 1
SAVED = -1  # the island of nodes that were loaded


def write_visual_map(graph: VisualGraph, path: Path) -> None:
    """Writes the views of a graph whose place in the map is known. The same map gives the same bytes."""
    nodes = [node for node in graph.nodes.values() if node.view is not None and node.island in graph.tied]
    views = [node.view for node in nodes if node.view is not None]
    arrays: dict[str, Any] = {
        "version": np.array(VERSION),
        "stamps": np.array([node.stamp for node in nodes], np.int64),
        "poses": np.array([node.T for node in nodes]).reshape(-1, 4, 4),
        "covariances": np.array([node.covariance for node in nodes]).reshape(-1, 6, 6),
        "features": np.array([len(view.pixels) for view in views], np.int64),
        "pixels": _joined([view.pixels for view in views], (0, 2), np.float32),
        "descriptors": _joined([view.descriptors for view in views], (0, 128), np.uint8),
        "points": _joined([view.points for view in views], (0, 3), np.float32),
        "shaded": np.array([len(view.shades) for view in views], np.int64),
        "shades": _joined([view.shades for view in views], (0,), np.uint8),
        "surface_shapes": np.array([view.surface.inverse_depth.shape for view in views], np.int64).reshape(-1, 2),
        "surface_K": np.array([view.surface.K for view in views]).reshape(-1, 3, 3),
        "surfaces": _joined([view.surface.inverse_depth.ravel() for view in views], (0,), np.float32),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as handle:
        np.savez_compressed(handle, **arrays)
    partial.replace(path)


def read_visual_map(path: Path) -> list[Node]:
    """Returns the nodes of a saved map. Raises ValueError for a file that is none."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            version = int(archive["version"])
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is no visual map ({type(error).__name__}: {error})") from None
    if version != VERSION:
        raise ValueError(f"{path} is a visual map of version {version}; this program reads version {VERSION}")
    try:
        return _nodes(arrays)
    except (ValueError, KeyError, IndexError) as error:
        raise ValueError(f"{path} is damaged: {type(error).__name__}: {error}") from None


def _nodes(a: dict[str, Any]) -> list[Node]:
    features, shaded = _ends(a["features"]), _ends(a["shaded"])
    cells = _ends(a["surface_shapes"].prod(axis=1))
    nodes = []
    for k, (stamp, T, covariance) in enumerate(zip(a["stamps"], a["poses"], a["covariances"], strict=True)):
        here, shades, patch = (slice(ends[k], ends[k + 1]) for ends in (features, shaded, cells))
        surface = Surface(a["surfaces"][patch].reshape(a["surface_shapes"][k]), a["surface_K"][k])
        view = View(a["pixels"][here], a["descriptors"][here], a["points"][here], surface, a["shades"][shades])
        nodes.append(Node(int(stamp), T, covariance, T, covariance, 0.0, SAVED, view))
    return nodes


def _joined(parts: Sequence[Any], empty: tuple[int, ...], kind: type) -> Any:
    return np.concatenate([np.zeros(empty, kind), *parts])


def _ends(lengths: Any) -> list[int]:
    return [0, *np.cumsum(lengths).tolist()]
