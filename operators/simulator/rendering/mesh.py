"""Things as meshes: what shading needs of each triangle, and each thing in a separate place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.simulator.shapes import Array, Patch
from operators.simulator.textures.atlas import Atlas
from operators.simulator.textures.painting import SIZE

APART = 64.0
"""Metres between things in the scene of silhouettes; no world is wider than half of it."""


class Scene(Protocol):
    """Holds what is used of Open3D's RaycastingScene; tensors are its own."""

    def add_triangles(self, vertices: Any, triangles: Any) -> int: ...

    def cast_rays(self, rays: Any, nthreads: int) -> Mapping[str, Any]: ...

    def test_occlusions(self, rays: Any, tnear: float, tfar: float, nthreads: int) -> Any: ...


class Mesh:
    """Patches of several things as one mesh, with what shading needs to know of each triangle."""

    def __init__(self, parts: list[tuple[int, int, Patch]], atlas: Atlas) -> None:
        """`parts` are (index of the thing, index of the part's pose, patch)."""
        patches = [patch for _, _, patch in parts]
        offsets = np.cumsum([0, *(len(p.vertices) for p in patches)])
        empty = np.zeros((0, 3))
        self.vertices = np.concatenate([empty, *(p.vertices for p in patches)])
        self.normals = np.concatenate([empty, *(p.normals for p in patches)])
        self.triangles = np.concatenate(
            [empty.astype(np.int64), *(p.triangles + o for p, o in zip(patches, offsets, strict=False))]
        )
        self.pose_of_vertex = np.repeat([pose for _, pose, _ in parts], [len(p.vertices) for p in patches]).astype(int)
        self.glow = np.repeat([p.material.glow for p in patches], [len(p.vertices) for p in patches])
        counts = [len(p.triangles) for p in patches]
        self.thing_of_triangle = np.repeat([thing for thing, _, _ in parts], counts).astype(np.int32)

        self.thing_of_vertex = np.zeros(len(self.vertices), np.int32)  # of those that are corners
        self.thing_of_vertex[self.triangles] = self.thing_of_triangle[:, None]

        uvs = np.concatenate([np.zeros((0, 2)), *(p.uvs for p in patches)])[self.triangles]
        uvs = uvs - np.floor(uvs.min(axis=1, keepdims=True, initial=np.inf)) if len(uvs) else uvs
        self.uv = uvs.astype(np.float32)  # (T, 3, 2)
        cell = [atlas.names.index(p.material.pattern) for p in patches]
        self.origin = np.repeat(atlas.origins[cell], counts, axis=0).reshape(-1, 2)
        tint = np.zeros((len(patches), 4), np.uint8)
        tint[:, :3] = [np.clip(np.rint(np.array(p.material.tint) * 255), 0, 255) for p in patches] if patches else 0
        self.tint = np.repeat(tint.view(np.uint32)[:, 0], counts)
        corners = self.vertices[self.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        e1, e2 = self.uv[:, 1] - self.uv[:, 0], self.uv[:, 2] - self.uv[:, 0]
        texels = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) * SIZE * SIZE
        self.density = np.sqrt(texels / np.maximum(area, 1e-12)).astype(np.float32)  # texels per metre


class SeparatedScene:
    """The same things, each in a separate place, far from all others: what each alone would look like."""

    def __init__(self, still: Mesh, moving: Mesh, build: Callable[[Array, NDArray[np.int64]], Scene]) -> None:
        self._build = build
        self._still, self._moving = still, moving
        self.scene = build(still.vertices + shift(still.thing_of_vertex), still.triangles)
        self._offset = shift(moving.thing_of_vertex)

    def movers(self, vertices: Array) -> Scene:
        return self._build(vertices + self._offset, self._moving.triangles)


def shift(things: NDArray[np.int32]) -> Array:
    shift = np.zeros((len(things), 3))
    shift[:, 0], shift[:, 1] = APART * (things % 32), APART * (things // 32)
    return shift


def placed(patch: Patch, T: Array) -> Patch:
    return Patch(
        transform_points(T, patch.vertices), patch.normals @ T[:3, :3].T, patch.uvs, patch.triangles, patch.material
    )
