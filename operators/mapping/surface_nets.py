"""The surface in a field of distances, as a mesh of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.mapping.tsdf import SIDE, DistanceField, keys_of

Array = NDArray[np.float64]

_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


@dataclass(frozen=True, eq=False)
class Surface:
    """Vertices (V, 3), metres in the map frame, with outward normals and RGB colours (V, 3), and triangles (T, 3)."""

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    triangles: NDArray[np.uint32]


def extract(field: DistanceField, voxel: float, min_weight: float) -> Surface:
    """Returns the surface where the distance changes its sign, between voxels that weigh at least `min_weight`.

    Surface nets: one vertex in each cube of eight voxels that the surface passes, the mean of where it crosses the
    cube's edges, and a quadrilateral across each voxel edge that it crosses. Gibson, "Constrained elastic surface
    nets", 1998, without the relaxation.
    """
    blocks, distance, weight, color = field.samples()
    if not len(blocks):
        return _empty()
    grid = _padded(blocks, distance, weight, color)
    values = np.stack([grid[..., 0][_window(c)] for c in _CORNERS], axis=-1)
    usable = np.stack([grid[..., 1][_window(c)] for c in _CORNERS], axis=-1).min(axis=-1) >= min_weight
    inside = values < 0
    crossed = usable & inside.any(axis=-1) & ~inside.all(axis=-1)
    block, *cell = np.nonzero(crossed)
    if not len(block):
        return _empty()
    cells = np.stack(cell, axis=1)
    place = blocks[block] * SIDE + cells
    values = values[crossed].astype(np.float64)
    total, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        crosses = (values[:, a] < 0) != (values[:, b] < 0)
        gap = np.where(crosses, values[:, a] - values[:, b], 1.0)
        share = np.where(crosses, values[:, a] / gap, 0.0)[:, None]
        total += np.where(crosses[:, None], _CORNERS[a] + share * (_CORNERS[b] - _CORNERS[a]), 0.0)
        count += crosses
    vertices = (place + total / count[:, None]) * voxel
    slope = np.stack([(values * (2 * _CORNERS[:, axis] - 1)).sum(axis=1) for axis in range(3)], axis=1)
    length = np.linalg.norm(slope, axis=1)
    normals = slope / np.maximum(length, 1e-12)[:, None]
    nearest = np.abs(values).argmin(axis=1)
    corner = cells + _CORNERS[nearest]
    colors = grid[block, corner[:, 0], corner[:, 1], corner[:, 2], 2:]
    return Surface(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.clip(np.rint(colors), 0, 255).astype(np.uint8),
        _triangles(place, values),
    )


def _empty() -> Surface:
    none = np.zeros((0, 3), np.float32)
    return Surface(none, none, none.astype(np.uint8), none.astype(np.uint32))


def _window(corner: NDArray[np.int64]) -> tuple[slice, ...]:
    return (slice(None), *(slice(c, c + SIDE) for c in corner))


def _padded(
    blocks: NDArray[np.int64], distance: NDArray[np.float32], weight: NDArray[np.float32], color: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns distance, weight, red, green, blue (B, 9, 9, 9, 5) of each block and its neighbours' next voxels."""
    shape = (len(blocks), SIDE, SIDE, SIDE)
    own = np.concatenate([a.reshape(*shape, -1) for a in (distance, weight, color)], axis=-1)
    grid = np.zeros((len(blocks), SIDE + 1, SIDE + 1, SIDE + 1, own.shape[-1]), np.float32)
    grid[:, :SIDE, :SIDE, :SIDE] = own
    keys = keys_of(blocks)
    for step in _CORNERS[1:]:
        beside = keys_of(blocks + step)
        at = np.minimum(np.searchsorted(keys, beside), len(keys) - 1)
        there = np.flatnonzero(keys[at] == beside)
        to = tuple(slice(SIDE, SIDE + 1) if s else slice(0, SIDE) for s in step)
        take = tuple(slice(0, 1) if s else slice(0, SIDE) for s in step)
        grid[there, to[0], to[1], to[2]] = own[at[there], take[0], take[1], take[2]]
    return grid


def _triangles(place: NDArray[np.int64], values: Array) -> NDArray[np.uint32]:
    """Returns triangles (T, 3), counter-clockwise seen from outside, of the vertices in cubes `place` (V, 3).

    The edge from a cube's first corner along an axis is shared by this cube and the three before it.
    """
    low = place.min(axis=0)
    size = place.max(axis=0) - low + 2
    stride = np.array([size[1] * size[2], size[2], 1])
    number = (place - low + 1) @ stride
    order = np.argsort(number, kind="stable")
    ranked = number[order]
    found = []
    for axis in range(3):
        first, last = values[:, 0] < 0, values[:, 4 >> axis] < 0
        edge = np.flatnonzero(first != last)
        b, c = (axis + 1) % 3, (axis + 2) % 3
        quad = np.stack(
            [number[edge], number[edge] - stride[b], number[edge] - stride[b] - stride[c], number[edge] - stride[c]],
            axis=1,
        )
        at = np.minimum(np.searchsorted(ranked, quad), len(ranked) - 1)
        whole = (ranked[at] == quad).all(axis=1)
        vertex = order[at[whole]]
        flip = ~first[edge[whole]]
        vertex[flip] = vertex[flip][:, ::-1]
        found += [vertex[:, [0, 1, 2]], vertex[:, [0, 2, 3]]]
    return np.concatenate(found).astype(np.uint32)
