"""Saved maps: one NumPy archive (.npz) of keyframes, where they are and what they saw."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from operators.slam.keyframe_graph import SAVED, Node
from operators.slam.place_graph import PlaceGraph

V = TypeVar("V")


def write_map(
    graph: PlaceGraph[V], path: Path, version: int, pack: Callable[[Sequence[V]], Mapping[str, Any]]
) -> None:  # fmt: skip
    """Writes the views of a graph whose place in the map is known. The same map gives the same bytes."""
    nodes = [node for node in graph.nodes.values() if node.view is not None and node.island in graph.tied]
    arrays: dict[str, Any] = {
        "version": np.array(version),
        "stamps": np.array([node.stamp for node in nodes], np.int64),
        "poses": np.array([node.T for node in nodes]).reshape(-1, 4, 4),
        "covariances": np.array([node.covariance for node in nodes]).reshape(-1, 6, 6),
        **pack([node.view for node in nodes if node.view is not None]),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as handle:
        np.savez_compressed(handle, **arrays)
    partial.replace(path)


def read_map(
    path: Path, kind: str, version: int, unpack: Callable[[Mapping[str, Any]], Sequence[V]]
) -> list[Node[V]]:  # fmt: skip
    """Returns the nodes of a saved map of a kind (`visual`). Raises ValueError for a file that is none."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = int(archive["version"])
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is no {kind} map ({type(error).__name__}: {error})") from None
    if found != version:
        raise ValueError(f"{path} is a {kind} map of version {found}; this program reads version {version}")
    try:
        return [
            Node(int(stamp), T, covariance, T, covariance, 0.0, SAVED, view)
            for stamp, T, covariance, view in zip(
                arrays["stamps"], arrays["poses"], arrays["covariances"], unpack(arrays), strict=True
            )
        ]
    except (ValueError, KeyError, IndexError) as error:
        raise ValueError(f"{path} is damaged: {type(error).__name__}: {error}") from None


def joined(parts: Sequence[Any], empty: tuple[int, ...], kind: type) -> Any:
    """Returns the arrays as one; `empty` is the shape of none."""
    return np.concatenate([np.zeros(empty, kind), *parts])


def ends(lengths: Any) -> list[int]:
    """Returns where each part of a joined array begins, and the end."""
    return [0, *np.cumsum(lengths).tolist()]
