"""Ray casting: what a camera or a lidar sees of a world at a time.

The still part of the world is one mesh whose hierarchy is built once. The movers are a second, small mesh that is built
again for every time that is looked at (2,000 triangles: 0.6 ms) and cast only within its own rectangle of the image;
the nearer hit counts. Light on still surfaces is computed once per vertex (lamps with shadows, and how open the place
is); on movers at every time, without shadows. Results do not depend on `threads`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.simulator.classes import CLASS_IDS, VOID
from operators.simulator.rendering.lighting import BakedLight, Floor, dimmed, direct
from operators.simulator.rendering.mesh import APART, Mesh, Scene, SeparatedScene, placed, shift
from operators.simulator.rendering.native import open3d
from operators.simulator.rendering.optics import F32, I32, Optics, View, camera_rays, inverse_lengths, rectangle
from operators.simulator.scene import World
from operators.simulator.shapes import Array, Patch
from operators.simulator.textures.atlas import LEVELS, make_atlas
from operators.simulator.textures.painting import SIZE

_CHUNK = 1 << 14  # pixels shaded at once: the work stays in the cache (and remap takes no more than 32,767)
_NONE = 0xFFFFFFFF
_SILHOUETTE_RAYS = 600  # about so many rays judge how much of a thing would be seen
_CUBE = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SHRINK = np.array([0.5**k for k in range(LEVELS)], np.float32)


@dataclass(frozen=True, eq=False)
class Hits:
    """Ends of rays (N): `distance` in units of the rays' directions (infinite for none), `things` index or -1."""

    distance: F32
    normals: F32
    things: I32
    brightness: F32


def always_on(t: float) -> float:
    """Lamps that shine at all times."""
    return 1.0


class Renderer:
    """Casts rays into one world. `at(t)` sets the time; everything else sees the world as it is then."""

    def __init__(
        self, world: World, seed: int, *, threads: int = 1, level: Callable[[float], float] = always_on
    ) -> None:
        """`level` is the share of their strength with which lamps shine at a time."""
        self._o3d = open3d()
        self.world, self._threads, self._level = world, threads, level
        things = world.things
        self._still = [k for k, thing in enumerate(things) if thing.still]
        self._movers = [k for k, thing in enumerate(things) if not thing.still]
        names = sorted({p.material.pattern for thing in things for part in thing.parts for p in part})
        self._atlas = make_atlas(names, seed)

        still: list[tuple[int, int, Patch]] = []
        for k in self._still:
            T = things[k].mover.frame(0.0)
            still += [(k, 0, placed(patch, T)) for patch in things[k].parts[0]]
        self._mesh = Mesh(still, self._atlas)
        self._scene = self._build(self._mesh.vertices, self._mesh.triangles)
        moving: list[tuple[int, int, Patch]] = []
        pose = 0
        for k in self._movers:
            for part in things[k].parts:
                moving += [(k, pose, patch) for patch in part]
                pose += 1
        self._moving = Mesh(moving, self._atlas)
        self._mover_vertices = [np.flatnonzero(self._moving.thing_of_vertex == k) for k in self._movers]

        lamps = [k for k, thing in enumerate(things) if thing.label == "lamp"]
        self._baked = BakedLight.of(world, self._mesh, lamps, self._occluded)
        both = (self._mesh, self._moving)
        self._thing_of_triangle = np.concatenate([m.thing_of_triangle for m in both])
        self._id_of_thing = np.array([*(thing.id for thing in things), 0], np.uint16)
        self._class_of_thing = np.array([*(CLASS_IDS[thing.label] for thing in things), VOID], np.uint8)
        uv = np.concatenate([m.uv for m in both])
        edges = [uv[:, 0], uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]]
        self._uv = [np.ascontiguousarray(e[:, k]) for k in (0, 1) for e in edges]  # u0, du1, du2, v0, dv1, dv2
        self._origin = [np.concatenate([m.origin[:, k] for m in both]) for k in (0, 1)]
        self._tint = np.concatenate([m.tint for m in both])
        self._density = np.concatenate([m.density for m in both])
        self._lights = [np.zeros(len(uv), np.float32) for _ in range(3)]  # l0, dl1, dl2
        self._first_moving = len(self._mesh.triangles)
        self._floor = Floor(self._mesh, [k for k, thing in enumerate(things) if thing.label == "floor"])
        self._lit: float | None = None
        self._time: float | None = None
        self._apart: SeparatedScene | None = None
        self._corners: dict[int, Array] = {}
        self.at(0.0)

    def at(self, t: float) -> None:
        """Poses the movers and switches the lamps."""
        if self._time == t:
            return
        self._time = t
        level = self._level(t)
        if level != self._lit:
            self._lit = level
            self._still_light = self._baked.at(level)
            self._set_light(slice(0, self._first_moving), self._mesh.triangles, self._still_light)
        self._apart_movers: Scene | None = None
        if not self._movers:
            return
        things = self.world.things
        poses = np.concatenate([things[k].mover.parts(t) for k in self._movers])
        of = poses[self._moving.pose_of_vertex]
        vertices = np.einsum("vij,vj->vi", of[:, :3, :3], self._moving.vertices) + of[:, :3, 3]
        normals = np.einsum("vij,vj->vi", of[:, :3, :3], self._moving.normals)
        self._moved = vertices
        self._moving_scene = self._build(vertices, self._moving.triangles)
        received = direct(self.world.lights, level, vertices, normals)
        received += dimmed(self.world, level) * self.world.ambient * (0.72 + 0.13 * normals[:, 2])
        light = np.where(self._moving.glow > 0, self._moving.glow, received).astype(np.float32)
        self._set_light(slice(self._first_moving, None), self._moving.triangles, light)
        shaded = self._floor.shaded(self._still_light, [vertices[own] for own in self._mover_vertices])
        self._set_light(self._floor.triangles, self._mesh.triangles[self._floor.triangles], shaded)

    def view(self, T_world_camera: Array, optics: Optics, *, color: bool = True) -> View:
        """Returns what a camera at `T_world_camera` (optical frame) sees now."""
        rays = camera_rays(T_world_camera, optics)
        depth, triangle, weights, normals = self._first_hit(self._scene, rays)
        for rows, columns in self._rectangles(T_world_camera, optics):
            part = np.ascontiguousarray(rays[rows, columns])
            d, i, w, n = self._first_hit(self._moving_scene, part)
            nearer = d < depth[rows, columns]
            depth[rows, columns][nearer] = d[nearer]
            triangle[rows, columns][nearer] = i[nearer] + self._first_moving
            weights[rows, columns][nearer] = w[nearer]
            normals[rows, columns][nearer] = n[nearer]
        cosine = np.abs(np.einsum("hwi,hwi->hw", normals, rays[..., 3:])) * inverse_lengths(optics)
        things = np.where(np.isfinite(depth), self._thing_of_triangle.take(triangle, mode="clip"), -1)
        instances = self._id_of_thing.take(things)
        classes = self._class_of_thing.take(things)
        pixels = self._shade(triangle, weights, depth, cosine, optics) if color else None
        return View(depth, cosine, triangle, instances, classes, pixels)

    def cast(self, rays: F32) -> Hits:
        """The first hits of rays (N, 6): origins and directions in the world."""
        distance, triangle, weights, normals = self._first_hit(self._scene, rays)
        if self._movers:
            d, i, w, n = self._first_hit(self._moving_scene, rays)
            nearer = d < distance
            distance = np.where(nearer, d, distance)
            triangle = np.where(nearer, i + self._first_moving, triangle)
            weights = np.where(nearer[..., None], w, weights)
            normals = np.where(nearer[..., None], n, normals)
        things = np.where(np.isfinite(distance), self._thing_of_triangle.take(triangle, mode="clip"), -1)
        tint = self._tint.take(triangle, mode="clip").view(np.uint8).reshape(-1, 4)[:, :3]
        return Hits(distance, normals, things.astype(np.int32), tint.mean(axis=1).astype(np.float32) / 255)

    def blocked(self, rays: F32) -> NDArray[np.bool_]:
        """Returns whether something lies on each ray (N, 6) before its direction's full length."""
        return np.asarray(self.cast(rays).distance < 1.0)

    def silhouette(self, things: list[int], T_world_camera: Array, optics: Optics) -> Array:
        """Pixels (N,) that each thing (index) would cover if nothing stood before it and the image had no border.

        Cast on a grid of about 600 rays per thing: exact where a thing's box in the image is smaller than that, else
        to about two per cent. Things that reach behind the camera are judged by what lies before it, within a
        border of one image size on each side.
        """
        if self._apart is None:
            self._apart = SeparatedScene(self._mesh, self._moving, self._build)
        counts = np.zeros(len(things))
        still: list[tuple[int, F32, int]] = []
        moving: list[tuple[int, F32, int]] = []
        T_camera_world = invert(T_world_camera)
        R = T_world_camera[:3, :3].astype(np.float32)
        for slot, k in enumerate(things):
            own = self._corners_of(k) if self.world.things[k].still else self._moved[self._vertices_of(k)]
            corners = rectangle(transform_points(T_camera_world, own), optics, margin=1.0)
            if corners is None:
                continue
            left, top, right, bottom = corners
            stride = max(1, int(np.ceil(np.sqrt((right - left) * (bottom - top) / _SILHOUETTE_RAYS))))
            u, v = np.meshgrid(
                np.arange(left + stride // 2, right, stride, dtype=np.float32),
                np.arange(top + stride // 2, bottom, stride, dtype=np.float32),
            )
            rays = np.empty((u.size, 6), np.float32)
            rays[:, :3] = T_world_camera[:3, 3]
            local = np.stack(
                [(u.ravel() - optics.cx) / optics.fx, (v.ravel() - optics.cy) / optics.fy, np.ones(u.size)]
            )
            rays[:, 3:] = (R @ local.astype(np.float32)).T
            rays[:, :2] += shift(np.array([k]))[0, :2].astype(np.float32)
            (still if self.world.things[k].still else moving).append((slot, rays, stride))
        scenes = [(still, self._apart.scene)] if still else []
        if moving:
            if self._apart_movers is None:
                self._apart_movers = self._apart.movers(self._moved)
            scenes.append((moving, self._apart_movers))
        for jobs, scene in scenes:
            distance, *_ = self._first_hit(scene, np.concatenate([rays for _, rays, _ in jobs]))
            end = 0
            for slot, rays, stride in jobs:
                near = distance[end : end + len(rays)] < 0.5 * APART
                counts[slot] = np.count_nonzero(near) * stride * stride
                end += len(rays)
        return counts

    def _corners_of(self, thing: int) -> Array:
        """The eight corners of a still thing's box, in the world."""
        if thing not in self._corners:
            T, size = self.world.things[thing].box(0.0)
            self._corners[thing] = transform_points(T, _CUBE * size)
        return self._corners[thing]

    def _vertices_of(self, thing: int) -> NDArray[np.int64]:
        return self._mover_vertices[self._movers.index(thing)]

    def _build(self, vertices: Array, triangles: NDArray[np.int64]) -> Scene:
        """A scene of one mesh. Open3D commits it at the first cast."""
        core = self._o3d.core
        scene: Scene = self._o3d.t.geometry.RaycastingScene(nthreads=self._threads)
        scene.add_triangles(core.Tensor(vertices.astype(np.float32)), core.Tensor(triangles.astype(np.uint32)))
        return scene

    def _first_hit(self, scene: Scene, rays: F32) -> tuple[F32, I32, F32, F32]:
        """Distance, triangle (0 where nothing is hit), weights of corners 1 and 2, and unit normal per ray (..., 6)."""
        tensor = self._o3d.core.Tensor.from_numpy(rays)
        answer = scene.cast_rays(tensor, nthreads=self._threads)
        distance = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy()
        index = np.where(triangle == _NONE, 0, triangle).astype(np.int32)
        return distance, index, answer["primitive_uvs"].numpy(), answer["primitive_normals"].numpy()

    def _occluded(self, rays: F32, far: float) -> NDArray[np.bool_]:
        tensor = self._o3d.core.Tensor.from_numpy(rays)
        answer = self._scene.test_occlusions(tensor, 1e-4, far, nthreads=self._threads)
        return np.asarray(answer.numpy())

    def _set_light(self, rows: slice | NDArray[np.int64], triangles: NDArray[np.int64], light: F32) -> None:
        """Enters the light on vertices (V,) for triangles that have these rows of the tables."""
        corner = light[triangles]
        self._lights[0][rows] = corner[:, 0]
        self._lights[1][rows] = corner[:, 1] - corner[:, 0]
        self._lights[2][rows] = corner[:, 2] - corner[:, 0]

    def _rectangles(self, T_world_camera: Array, optics: Optics) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of the image that each mover may cover."""
        T_camera_world = invert(T_world_camera)
        for vertices in self._mover_vertices:
            corners = rectangle(transform_points(T_camera_world, self._moved[vertices]), optics, margin=0.0)
            if corners is not None:
                left, top, right, bottom = corners
                yield slice(top, bottom), slice(left, right)

    def _shade(self, triangle: I32, weights: F32, depth: F32, cosine: F32, optics: Optics) -> F32:
        """Texture times tint times light (H, W, 3)."""
        shape = depth.shape
        flat, w = triangle.reshape(-1), weights.reshape(-1, 2)
        z, c = depth.reshape(-1), cosine.reshape(-1)
        out = np.empty((len(flat), 3), np.float32)
        focal = np.float32(1 / optics.fx)
        for start in range(0, len(flat), _CHUNK):
            part = slice(start, start + _CHUNK)
            i = flat[part]
            b1, b2 = np.ascontiguousarray(w[part, 0]), np.ascontiguousarray(w[part, 1])
            u, v = (self._uv[k].take(i) + b1 * self._uv[k + 1].take(i) + b2 * self._uv[k + 2].take(i) for k in (0, 3))
            light = self._lights[0].take(i) + b1 * self._lights[1].take(i) + b2 * self._lights[2].take(i)
            footprint = np.minimum(z[part], 100) * focal * self._density.take(i) / np.sqrt(np.maximum(c[part], 0.08))
            level = np.clip(np.log2(np.maximum(footprint, 1)), 0, LEVELS - 1).astype(np.int32)
            shrink = _SHRINK.take(level)
            x = ((u - np.floor(u)) * SIZE + self._origin[0].take(i)) * shrink + self._atlas.left.take(level)
            y = ((v - np.floor(v)) * SIZE + self._origin[1].take(i)) * shrink + self._atlas.top.take(level)
            half = np.float32(0.5)  # the middle of texel 0 is at coordinate 0
            texels = cv2.remap(self._atlas.image, (x - half)[None], (y - half)[None], cv2.INTER_LINEAR)[0]
            tint = np.ascontiguousarray(self._tint.take(i).view(np.uint8).reshape(-1, 4)[:, :3])
            albedo = cv2.multiply(texels, tint, scale=1 / 255)
            out[part] = cv2.multiply(albedo, cv2.merge([light, light, light]).reshape(-1, 3), dtype=cv2.CV_32F)
        out[~np.isfinite(z)] = self.world.sky
        return out.reshape(*shape, 3)
