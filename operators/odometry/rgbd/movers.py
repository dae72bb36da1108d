"""Parts of a view that stand in front of where the map has its surfaces: something has moved there."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Points
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.alignment import PlaneTerm
from operators.odometry.rgbd.surface import Surface

TILE = 8  # patches on a side
FEWEST = 4  # compared points that a tile is judged by


@dataclass(frozen=True, eq=False)
class Movers:
    """Tiles of a surface's grid in which something moves, their neighbours included."""

    tiles: NDArray[np.bool_]  # (rows, columns)
    K: Matrix  # (3, 3) of the grid

    @staticmethod
    def none(K: Matrix, shape: tuple[int, int]) -> "Movers":
        """Returns what a view of a world that stands still has."""
        return Movers(np.zeros(_tiles(shape), np.bool_), K)

    @staticmethod
    def between(
        K: Matrix, shape: tuple[int, int], points: Points, terms: Sequence[PlaneTerm], T_world_camera: Matrix
    ) -> "Movers":
        """Compares points (N, 3) of a view, on whose grid of a shape (h, w) K projects, with reference surfaces.

        A tile moves where most of its points lie nearer than any of the references allows: an old one reveals
        slow motion. Points that lie farther were hidden by something that has left, and are static.
        """
        rows, columns = _tiles(shape)
        tile = _tile_of(points, K, (rows, columns))
        moving = np.zeros(rows * columns, np.bool_)
        for term in terms:
            seen, in_front, same = term.compare(T_world_camera)
            nearer = np.bincount(tile[seen[in_front]], minlength=rows * columns)
            compared = np.bincount(tile[seen[in_front | same]], minlength=rows * columns)
            moving |= (nearer > 0.5 * compared) & (compared >= FEWEST)
        return Movers(_grown(moving.reshape(rows, columns)), K)

    def around(self, points: Points) -> "Movers":
        """Returns these and the tiles around points (N, 3), in the view's depth camera, that are known to move."""
        if not len(points):
            return self
        moving = np.zeros(self.tiles.size, np.bool_)
        moving[_tile_of(points, self.K, self.tiles.shape)] = True
        return self.also(Movers(_grown(moving.reshape(self.tiles.shape)), self.K))

    def also(self, others: "Movers") -> "Movers":
        """Returns these and others of the same grid."""
        return Movers(self.tiles | others.tiles, self.K)

    def hold(self, points: Points) -> NDArray[np.bool_]:
        """Returns which of the points (N, 3), in the view's depth camera, lie in a moving tile."""
        if not self.tiles.any():
            return np.zeros(len(points), np.bool_)
        return np.asarray(self.tiles.ravel()[_tile_of(points, self.K, self.tiles.shape)], np.bool_)

    def left_out_of(self, surface: Surface) -> Surface:
        """Returns a surface on the same grid without its moving tiles: later views are not to be laid on them."""
        if not self.tiles.any():
            return surface
        h, w = surface.inverse_depth.shape
        moving = np.kron(self.tiles, np.ones((TILE, TILE), np.bool_))[:h, :w]
        return Surface(np.where(moving, np.float32(0), surface.inverse_depth), surface.K)


def _tiles(shape: tuple[int, int]) -> tuple[int, int]:
    return -(-shape[0] // TILE), -(-shape[1] // TILE)


def _grown(tiles: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the tiles and their neighbours."""
    return cv2.dilate(tiles.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _tile_of(points: Points, K: Matrix, tiles: tuple[int, ...]) -> NDArray[np.int64]:
    """Returns the flat index of the tile that each point (N, 3) projects into; outside, the nearest one."""
    x, y, z = points.T
    column: NDArray[np.int64] = np.clip((x / z * K[0, 0] + K[0, 2] + 0.5) / TILE, 0, tiles[1] - 1).astype(np.int64)
    row: NDArray[np.int64] = np.clip((y / z * K[1, 1] + K[1, 2] + 0.5) / TILE, 0, tiles[0] - 1).astype(np.int64)
    return row * tiles[1] + column
