"""Triangle meshes made of primitives: boxes, lathes, spheres and bones, each patch with its material.

Lengths in metres; z is up in every object's own frame and its origin lies in the middle of what it stands on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points

Array = NDArray[np.float64]
Color = tuple[float, float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """A texture pattern multiplied by a tint (RGB, [0, 1]).

    `tile` is the size of one repetition in metres; 0 stretches the pattern over the face. `glow` > 0 is a surface that
    shines by itself (a screen, a window) and takes no light.
    """

    pattern: str
    tint: Color = (1.0, 1.0, 1.0)
    tile: float = 1.0
    glow: float = 0.0


@dataclass(frozen=True, eq=False)
class Patch:
    """One connected piece of surface of one material.

    `vertices` and `normals` (V, 3), `uvs` (V, 2) in repetitions of the pattern, `triangles` (T, 3), counter-clockwise
    seen from outside.
    """

    vertices: Array
    normals: Array
    uvs: Array
    triangles: NDArray[np.int64]
    material: Material


Shape = tuple[Patch, ...]


def moved(shape: Shape, T: Array) -> Shape:
    """The shape under a rigid transform (4, 4)."""
    R = T[:3, :3]
    return tuple(
        replace(patch, vertices=transform_points(T, patch.vertices), normals=patch.normals @ R.T) for patch in shape
    )


def at(shape: Shape, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Shape:
    """The shape turned about z, then shifted."""
    return moved(shape, pose(x, y, z, yaw))


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Array:
    """A rigid transform (4, 4): a turn about z and a shift."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def bounds(shape: Shape) -> tuple[Array, Array]:
    """Smallest and largest x, y, z of the vertices."""
    vertices = np.concatenate([patch.vertices for patch in shape])
    return vertices.min(axis=0), vertices.max(axis=0)


def sheet(corner: Vector | Array, along: Vector | Array, up: Vector | Array, material: Material, cell: float) -> Patch:
    """A rectangle from `corner` along two perpendicular edge vectors, divided into cells of at most `cell`.

    Its normal is along × up.
    """
    p, a, b = (np.asarray(v, np.float64) for v in (corner, along, up))
    la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    na, nb = max(1, math.ceil(la / cell - 1e-9)), max(1, math.ceil(lb / cell - 1e-9))
    s, t = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, na + 1), np.linspace(0, 1, nb + 1), indexing="ij"))
    normal = np.cross(a, b) / (la * lb)
    if material.tile > 0:
        uvs = np.stack([s * la / material.tile, -t * lb / material.tile], axis=1)
    else:
        uvs = np.stack([s, 1 - t], axis=1) * 0.996 + 0.002
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(na), np.arange(nb), indexing="ij"))
    first = i * (nb + 1) + j
    quads = np.stack([first, first + nb + 1, first + nb + 2, first + 1], axis=1)
    return Patch(
        p + s[:, None] * a + t[:, None] * b,
        np.tile(normal, (len(s), 1)),
        uvs,
        np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]),
        material,
    )


def box(
    size: Vector,
    material: Material,
    *,
    center: Vector | None = None,
    front: Material | None = None,
    top: Material | None = None,
    cell: float = 0.25,
) -> Shape:
    """An axis-parallel box standing on z = 0, or about `center`; its front is the +x face."""
    sx, sy, sz = size
    c = np.array((0.0, 0.0, sz / 2) if center is None else center)
    x, y, z = np.array([sx, 0, 0]), np.array([0, sy, 0]), np.array([0, 0, sz])
    low, high = c - (x + y + z) / 2, c + (x + y + z) / 2
    return (
        sheet(low + x, y, z, front or material, cell),
        sheet(high - x - z, -y, z, material, cell),
        sheet(high - z, -x, z, material, cell),
        sheet(low, x, z, material, cell),
        sheet(low + z, x, y, top or material, cell),
        sheet(low + x, -x, y, material, cell),
    )


def lathe(
    profile: Sequence[tuple[float, float]], material: Material, *, segments: int = 20, smooth: bool = False
) -> Shape:
    """The surface swept by a profile of (radius, z) points, from bottom to top, turned about z.

    `smooth` rounds the shading along the profile too; otherwise its corners stay sharp.
    """
    r, z = np.array(profile, np.float64).T
    dr, dz = np.diff(r), np.diff(z)
    length = np.hypot(dr, dz)
    edge = np.stack([dz, -dr], axis=1) / np.maximum(length, 1e-12)[:, None]  # (radial, z) normal of each piece
    if smooth:
        corner = np.concatenate([edge[:1], edge[:-1] + edge[1:], edge[-1:]])
        corner /= np.linalg.norm(corner, axis=1, keepdims=True)
        rings = [(r[k], z[k], corner[k]) for k in range(len(r))]
        pairs = [(k, k + 1) for k in range(len(r) - 1)]
    else:
        rings = [(r[k + e], z[k + e], edge[k]) for k in range(len(dr)) for e in (0, 1)]
        pairs = [(2 * k, 2 * k + 1) for k in range(len(dr))]
    run = np.concatenate([[0], np.cumsum(length)])
    along = run if smooth else np.repeat(run, 2)[1:-1]
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    c, s = np.cos(angle), np.sin(angle)
    vertices = np.concatenate([np.stack([q * c, q * s, np.full_like(c, h)], axis=1) for q, h, _ in rings])
    normals = np.concatenate([np.stack([n[0] * c, n[0] * s, np.full_like(c, n[1])], axis=1) for _, _, n in rings])
    tile = material.tile
    if tile > 0:
        around = max(1.0, round(2 * math.pi * float(r.max()) / tile))
        uvs = np.concatenate([np.stack([angle / (2 * math.pi) * around, np.full_like(c, -w / tile)], 1) for w in along])
    else:
        total = max(float(run[-1]), 1e-9)
        uvs = np.concatenate([np.stack([angle / (2 * math.pi), np.full_like(c, 1 - w / total)], 1) for w in along])
        uvs = uvs * 0.996 + 0.002
    k = np.arange(segments)
    triangles = []
    for lower, upper in pairs:
        a, b = lower * (segments + 1) + k, upper * (segments + 1) + k
        if rings[lower][0] > 0:
            triangles.append(np.stack([a, a + 1, b + 1], axis=1))
        if rings[upper][0] > 0:
            triangles.append(np.stack([a, b + 1, b], axis=1))
    return (Patch(vertices, normals, uvs, np.concatenate(triangles), material),)


def cylinder(radius: float, height: float, material: Material, *, segments: int = 16) -> Shape:
    """A closed cylinder standing on z = 0."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)], material, segments=segments)


def ellipsoid(rx: float, ry: float, rz: float, material: Material, *, segments: int = 20, rings: int = 10) -> Shape:
    """An ellipsoid about the origin."""
    a = np.linspace(-math.pi / 2, math.pi / 2, rings + 1)
    profile = [(max(0.0, math.cos(x)), math.sin(x)) for x in a]
    profile[0], profile[-1] = (0.0, -1.0), (0.0, 1.0)
    (ball,) = lathe(profile, material, segments=segments, smooth=True)
    scale = np.array([rx, ry, rz])
    unit = ball.vertices
    normals = unit / scale
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uvs = ball.uvs
    if material.tile > 0:
        largest = max(rx, ry, rz)
        uvs = np.stack(
            [
                ball.uvs[:, 0]
                * max(1.0, round(2 * math.pi * largest / material.tile))
                / max(ball.uvs[:, 0].max(), 1e-9),
                np.arcsin(np.clip(unit[:, 2], -1, 1)) * largest / material.tile,
            ],
            axis=1,
        )
    return (replace(ball, vertices=unit * scale, normals=normals, uvs=uvs),)


def bone(length: float, r0: float, r1: float, material: Material, *, segments: int = 10, flat: float = 1.0) -> Shape:
    """A limb along +z from the origin with round ends, radius `r0` at the origin and `r1` at the far end.

    `flat` scales it along x: the chest is wider than deep.
    """
    a = np.linspace(0, math.pi / 2, 4)
    profile = [(r0 * math.sin(x), -r0 * math.cos(x)) for x in a] + [
        (r1 * math.cos(x), length + r1 * math.sin(x)) for x in a
    ]
    profile[0], profile[-1] = (0.0, -r0), (0.0, length + r1)
    (limb,) = lathe(profile, material, segments=segments, smooth=True)
    scale = np.array([flat, 1.0, 1.0])
    normals = limb.normals / scale
    return (replace(limb, vertices=limb.vertices * scale, normals=normals / np.linalg.norm(normals, axis=1)[:, None]),)
