"""Divides what a camera sees into smooth pieces, by jumps of range and by edges at which surfaces meet inwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]
Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]
Surface = NDArray[np.float32]

_HOLE = 3  # cells: neighbours in a row or column with no other cell between them, up to so far
_ARM = 3  # cells on each side of a link by which its bend is measured
_BEND = np.float32(np.cos(np.radians(35.0)))  # of the angle towards the viewer from which a surface is another
_LARGEST = 1 << 18  # cells


def range_segments(points: Array, pixels: Array, inside: Mask, reach: Array) -> Labels:
    """Returns the piece (N,) of each point (N, 3), -1 for those that are not `inside` the image or in their own cell.

    `pixels` (N, 2) are the points' places in the image, `reach` (N,) how near neighbours of one surface are. Neighbours
    in the grid of cells that the points span are of one piece where they are near each other and their surface does not
    turn towards the viewer between them: things stand on what they touch by such edges. After Rabbani et al.,
    "Segmentation of point clouds using smoothness constraint", 2006, and Stein et al., "Object partitioning using local
    convexity", 2014.
    """
    labels = np.full(len(points), -1, np.int32)
    rows = np.flatnonzero(inside)
    if not len(rows):
        return labels
    grid, cell_of = _grid(points[rows], pixels[rows])
    owner = grid.ravel()
    there = owner >= 0
    P = np.full((3, grid.size), np.nan, np.float32)
    P[:, there] = points[rows[owner[there]]].T
    near: NDArray[np.float32] = np.zeros(grid.size, np.float32)
    near[there] = reach[rows[owner[there]]]
    P, near, number = P.reshape(3, *grid.shape), near.reshape(grid.shape), np.arange(grid.size).reshape(grid.shape)
    across, down = _links(P, near, number), _links(P.transpose(0, 2, 1).copy(), near.T.copy(), number.T)
    a, b = np.concatenate([across[0], down[0]]), np.concatenate([across[1], down[1]])
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), (grid.size, grid.size))
    piece = connected_components(graph, directed=False)[1]
    apart = points[rows] - points[rows[owner[cell_of]]]
    own = np.einsum("ij,ij->i", apart, apart) <= reach[rows] ** 2
    labels[rows[own]] = np.unique(piece[cell_of[own]], return_inverse=True)[1]
    return labels


def _grid(points: Array, pixels: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the nearest point of each cell (H, W), -1 for none, and the cell (N,), row by row, of each point."""
    low = pixels.min(axis=0)
    extent = pixels.max(axis=0) - low + 1
    steps = np.abs(np.diff(pixels, axis=0)).max(axis=1)
    side = max(float(np.sqrt(extent.prod() / len(points))), 1.0)
    if len(steps):
        side = max(min(side, float(np.median(steps))), float(np.sqrt(extent.prod() / _LARGEST)), 1.0)
    column, row = np.floor((pixels - low) / side + 1e-6).astype(np.intp).T
    shape = int(row.max()) + 1, int(column.max()) + 1
    cell = row * shape[1] + column
    farthest_first = np.argsort(-np.einsum("ij,ij->i", points, points), kind="stable")
    grid = np.full(shape[0] * shape[1], -1, np.intp)
    grid[cell[farthest_first]] = farthest_first
    return grid.reshape(shape), cell


def _links(P: Surface, near: Surface, number: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the `number` (H, W) of both ends of the links in the rows of points (3, H, W), NaN for none.

    `near` (H, W) is how near linked points are.
    """
    there = np.isfinite(P[0])
    first, second, empty = [], [], np.ones((there.shape[0], there.shape[1]), np.bool_)
    bent = _bent(P)
    for step in range(1, min(_HOLE, there.shape[1] - 1) + 1):
        apart = P[:, :, step:] - P[:, :, :-step]
        limit = np.maximum(near[:, step:], near[:, :-step])
        with np.errstate(invalid="ignore"):
            linked = (apart * apart).sum(axis=0) <= limit * limit
            if step == 1:
                linked |= _goes_on(P, apart, limit)
        linked &= ~bent[:, :-step] & empty[:, : linked.shape[1]]
        first.append(number[:, :-step][linked])
        second.append(number[:, step:][linked])
        empty[:, :-step] &= ~there[:, step:]
        bent[:, :-1] |= bent[:, 1:]
    return np.concatenate(first), np.concatenate(second)


def _goes_on(P: Surface, apart: Surface, limit: Surface) -> Mask:
    """Tells of neighbours in rows (H, W - 1) whether a surface that is seen at a flat angle goes on between them.

    Then the steps before and after, of points (3, H, W), are about as long as the one between them.
    """
    on = np.zeros(limit.shape, np.bool_)
    if limit.shape[1] < 3:
        return on
    turns = np.diff(apart, axis=2)
    small = (turns * turns).sum(axis=0) <= 0.25 * limit[:, 1:] ** 2
    on[:, 1:-1] = small[:, :-1] & small[:, 1:] & ((apart * apart).sum(axis=0) <= 16 * limit * limit)[:, 1:-1]
    return on


def _bent(P: Surface) -> Mask:
    """Tells of cells (H, W) whether the surface turns towards the viewer between them and the next in their row."""
    bent = np.zeros(P.shape[1:], np.bool_)
    if P.shape[2] < 2 * _ARM:
        return bent
    here = P[:, :, _ARM - 1 : -_ARM]
    a, b = here - P[:, :, : -2 * _ARM + 1], P[:, :, 2 * _ARM - 1 :] - P[:, :, _ARM : -_ARM + 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        a /= np.sqrt((a * a).sum(axis=0))
        b /= np.sqrt((b * b).sum(axis=0))
        bent[:, _ARM - 1 : -_ARM] = ((a * b).sum(axis=0) < _BEND) & (((b - a) * here).sum(axis=0) < 0)
    wide = bent.copy()  # a gap in a line of such cells would let one piece flow into the other
    wide[1:] |= bent[:-1]
    wide[:-1] |= bent[1:]
    return wide
