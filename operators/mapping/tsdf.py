"""A truncated signed distance field in blocks of voxels, from depth images and their poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from dataflow.operator import Remembered
from operators.geometry.se3 import Matrix

Array = NDArray[np.float64]
Keys = NDArray[np.int64]
Rows = NDArray[np.intp]
Values = NDArray[np.float32]

SIDE = 8  # voxels along the side of a block
_OFFSET = 1 << 20  # blocks along one axis on either side of the origin; three such numbers fit one int64
_VALUES = ("_distance", "_weight", "_color")


@dataclass(frozen=True)
class FieldSettings:
    """Lengths in metres. A voxel's weight stays within `most_weight`; the field has no more than `most_blocks`."""

    voxel: float
    truncation: float
    near: float
    far: float
    most_weight: float
    most_blocks: int


def keys_of(blocks: NDArray[np.int64] | NDArray[np.float64]) -> Keys:
    """Returns one number (N,) for each block (N, 3), ordered by x, y, z. Raises ValueError if too far."""
    if len(blocks) and not np.abs(blocks).max() < _OFFSET:
        raise ValueError("the field reaches farther than a million blocks from the origin")
    return np.asarray((blocks.astype(np.int64) + _OFFSET) @ np.array([1 << 42, 1 << 21, 1], np.int64))


def blocks_of(keys: Keys) -> NDArray[np.int64]:
    """Returns the blocks (N, 3) of numbers (N,)."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - _OFFSET


class DistanceField(Remembered):
    """Distances from surfaces, positive on the sensors' side, as weighted means at the corners of voxels.

    Voxel (i, j, k) of a block is the point (block * 8 + (i, j, k)) * voxel in the map frame. Blocks are made where
    depth ends. Curless and Levoy, "A volumetric method for building complex models from range images", 1996; weights
    fall with the squared depth, as the information of a depth camera does; blocks as in Nießner et al., "Real-time 3D
    reconstruction at scale using voxel hashing", 2013, kept sorted instead of hashed.
    """

    _keys: Keys  # sorted
    _rows: Rows  # of each key
    _distance: Values
    _weight: Values
    _color: Values

    def __init__(self, settings: FieldSettings) -> None:
        self._settings = settings
        self._keys, self._rows = np.zeros(0, np.int64), np.zeros(0, np.intp)
        self._distance = np.zeros((64, SIDE**3), np.float32)
        self._weight = np.zeros((64, SIDE**3), np.float32)
        self._color = np.zeros((64, SIDE**3, 3), np.float32)
        corner = np.arange(SIDE)
        self._corners = np.stack(np.meshgrid(corner, corner, corner, indexing="ij"), axis=-1).reshape(-1, 3)

    def __len__(self) -> int:
        return len(self._keys)

    def integrate(
        self, depth: NDArray[np.float32], image: NDArray[np.uint8] | None, K: Matrix, T_map_camera: Matrix
    ) -> int:
        """Takes depth (H, W), metres, with colours (H, W, 3) of the same pixels; returns how many voxels it told of.

        Raises ValueError where there would be more than `most_blocks`.
        """
        s = self._settings
        z = np.where((depth >= s.near) & (depth <= s.far), depth, np.float32(0))
        touched = self._touched(z, K, T_map_camera)
        if not len(touched):
            return 0
        T = invert(T_map_camera)
        touched = np.union1d(touched, self._before(z, K, T))
        rows = self._rows_of(touched)
        size = s.voxel
        base = blocks_of(touched) * (SIDE * size) @ T[:3, :3].T + T[:3, 3]
        own = (self._corners * size @ T[:3, :3].T).astype(np.float32)
        x, y, depth_of = ((base[:, k : k + 1].astype(np.float32) + own[:, k]).reshape(-1) for k in range(3))
        ahead = np.maximum(depth_of, np.float32(1e-3))
        u = np.rint(x / ahead * np.float32(K[0, 0]) + np.float32(K[0, 2]))
        v = np.rint(y / ahead * np.float32(K[1, 1]) + np.float32(K[1, 2]))
        height, width = depth.shape
        within = np.flatnonzero((u >= 0) & (u < width) & (v >= 0) & (v < height) & (depth_of > 0))
        pixel = v[within].astype(np.int32) * width + u[within].astype(np.int32)
        measured = z.reshape(-1)[pixel]
        distance = measured - depth_of[within]
        told = np.flatnonzero((measured > 0) & (distance > -s.truncation))
        within, pixel, measured, distance = within[told], pixel[told], measured[told], distance[told]
        distance = np.minimum(distance, np.float32(s.truncation))
        slot = (rows[:, None] * SIDE**3 + np.arange(SIDE**3)).reshape(-1)[within]
        weight = 1 / np.maximum(np.square(measured), np.float32(0.25))
        flat_distance, flat_weight = self._distance.reshape(-1), self._weight.reshape(-1)
        before = flat_weight[slot]
        total = before + weight
        flat_distance[slot] += (distance - flat_distance[slot]) * (weight / total)
        flat_weight[slot] = np.minimum(total, np.float32(s.most_weight))
        if image is not None:
            flat = self._color.reshape(-1, 3)
            share = (weight / total)[:, None]
            flat[slot] += (image.reshape(-1, 3)[pixel] - flat[slot]) * share
        return len(slot)

    def samples(self) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Returns blocks (B, 3), sorted, with distance, weight (B, 512) and colour (B, 512, 3) of their voxels."""
        rows = self._rows
        return blocks_of(self._keys), self._distance[rows], self._weight[rows], self._color[rows]

    def prepare_snapshot(self) -> None:
        for name in _VALUES:
            setattr(self, name, getattr(self, name)[: len(self._keys)])

    def _touched(self, z: NDArray[np.float32], K: Matrix, T_map_camera: Matrix) -> Keys:
        """Returns the sorted numbers of the blocks within the truncation of the depth image's ends."""
        s = self._settings
        v, u = np.nonzero(z[::2, ::2])
        v, u = 2 * v, 2 * u
        ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], axis=1)
        ray = ray @ T_map_camera[:3, :3].T
        block = SIDE * s.voxel
        found = []
        for off in np.linspace(-s.truncation, s.truncation, max(3, int(np.ceil(4 * s.truncation / block)) + 1)):
            points = ray * (z[v, u].astype(np.float64) + off)[:, None] + T_map_camera[:3, 3]
            found.append(np.unique(keys_of(np.floor(points / block))))
        return np.unique(np.concatenate(found)) if found else np.zeros(0, np.int64)

    def _before(self, z: NDArray[np.float32], K: Matrix, T_camera_map: Matrix) -> Keys:
        """Returns the numbers of the known blocks that the camera looks through: what has gone is carved away."""
        half = SIDE * self._settings.voxel / 2
        points = (blocks_of(self._keys) * 2 + 1) * half @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
        ahead = points[:, 2] > self._settings.near
        points, keys = points[ahead], self._keys[ahead]
        u = np.rint(points[:, 0] / points[:, 2] * K[0, 0] + K[0, 2]).astype(np.int64)
        v = np.rint(points[:, 1] / points[:, 2] * K[1, 1] + K[1, 2]).astype(np.int64)
        height, width = z.shape
        seen = np.flatnonzero((u >= 0) & (u < width) & (v >= 0) & (v < height))
        return np.asarray(keys[seen][points[seen, 2] < z[v[seen], u[seen]]])

    def _rows_of(self, keys: Keys) -> Rows:
        """Returns the rows of blocks, which are made where they are missing."""
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), np.bool_)
        if len(self._keys):
            known = self._keys[np.minimum(at, len(self._keys) - 1)] == keys
        new = keys[~known]
        count = len(self._keys) + len(new)
        if count > self._settings.most_blocks:
            raise ValueError(f"the surface needs {count} blocks of voxels, more than most_blocks")
        if count > len(self._distance):
            room = max(count, 2 * len(self._distance)) - len(self._distance)
            for name in _VALUES:
                values = getattr(self, name)
                setattr(self, name, np.concatenate([values, np.zeros((room, *values.shape[1:]), np.float32)]))
        rows = np.concatenate([self._rows, np.arange(len(self._keys), count)])
        joined = np.concatenate([self._keys, new])
        order = np.argsort(joined, kind="stable")
        self._keys, self._rows = joined[order], rows[order]
        return self._rows[np.searchsorted(self._keys, keys)]
