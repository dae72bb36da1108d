"""Light on vertices: lamps with soft shadows, ambient light where the surroundings are open, shadows below movers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.simulator.rendering.mesh import Mesh
from operators.simulator.rendering.optics import F32
from operators.simulator.scene import Light, World
from operators.simulator.shapes import Array


@dataclass(frozen=True, eq=False)
class BakedLight:
    """Light on still vertices (V,) by where it comes from; `shades` are those of lamps, which shine as lamps do."""

    world: World
    lamps: Array
    sun: Array
    ambient: Array
    glow: Array
    shades: NDArray[np.bool_]

    @classmethod
    def of(
        cls, world: World, mesh: Mesh, lamps: list[int], occluded: Callable[[F32, float], NDArray[np.bool_]]
    ) -> BakedLight:
        """`lamps` are the indices of things whose glow is that of a lamp."""
        lamps_light, sun, ambient = _bake(world, mesh.vertices, mesh.normals, occluded)
        return cls(world, lamps_light, sun, ambient, mesh.glow, np.isin(mesh.thing_of_vertex, lamps))

    def at(self, level: float) -> F32:
        """The light (V,) where lamps shine with a share of their strength."""
        received = level * self.lamps + self.sun + dimmed(self.world, level) * self.ambient
        glow = np.where(self.shades, self.glow * max(level, 0.3), self.glow)  # a dark shade is white cloth
        return np.where(self.glow > 0, glow, received).astype(np.float32)


def dimmed(world: World, level: float) -> float:
    """The share of ambient light where lamps shine with a share of their strength: the rest is daylight."""
    return 1 - (1 - world.daylight) * (1 - level)


class Floor:
    """The floor's light, dimmed below movers: a soft shadow without which they would seem to float."""

    def __init__(self, mesh: Mesh, floors: list[int]) -> None:
        self.triangles = np.flatnonzero(np.isin(mesh.thing_of_triangle, floors))
        self._vertices = np.unique(mesh.triangles[self.triangles])
        self._places = mesh.vertices[self._vertices, :2]

    def shaded(self, light: F32, movers: list[Array]) -> F32:
        """Light (V,) on all still vertices, given that without movers and the movers' vertices (N, 3)."""
        factor = np.ones(len(self._vertices))
        for vertices in movers:
            low = vertices[vertices[:, 2] < 0.35, :2]
            if len(low):
                middle, spread = low.mean(axis=0), 0.1 + low.std(axis=0).mean()
                square = ((self._places - middle) ** 2).sum(axis=1)
                factor *= 1 - 0.45 * np.exp(-square / (2 * spread**2))
        light = light.copy()
        light[self._vertices] *= factor.astype(np.float32)
        return light


def direct(lights: tuple[Light, ...], level: float, points: Array, normals: Array) -> Array:
    """Direct light (V,) on points with normals, without shadows; lamps shine with a share `level` of their strength."""
    total = np.zeros(len(points))
    for light in lights:
        received = _lamp(light, np.array(light.position), points, normals)
        if light.area is not None:
            received *= ((points[:, :2] >= light.area[0]) & (points[:, :2] <= light.area[1])).all(axis=1)
        total += level * received if light.switched else received
    return total


def _lamp(light: Light, position: Array, points: Array, normals: Array) -> Array:
    to = position - points
    square = (to * to).sum(axis=1)
    lambert = np.maximum(0, (to * normals).sum(axis=1)) / np.sqrt(np.maximum(square, 1e-9))
    return np.asarray(light.strength * lambert / np.maximum(square, 0.25))


def _bake(
    world: World, vertices: Array, normals: Array, occluded: Callable[[F32, float], NDArray[np.bool_]]
) -> tuple[Array, Array, Array]:
    """Light (V,) on still vertices: of lamps, with soft shadows, of the sun, and ambient where it is open around."""
    rng = np.random.default_rng(20)  # only where on a lamp and in the half sphere the few samples lie
    start = vertices + 4e-3 * normals
    lamps, sun = np.zeros(len(vertices)), np.zeros(len(vertices))
    samples = 4
    for light in world.lights:
        total = lamps if light.switched else sun
        for _ in range(samples):
            spot = np.array(light.position) + rng.uniform(-1, 1, 3) * [light.radius, light.radius, 0.02]
            received = _lamp(light, spot, vertices, normals)
            lit = received > 1e-4
            rays = np.concatenate([start[lit], spot - start[lit]], axis=1).astype(np.float32)
            received[lit] *= ~occluded(rays, 0.999)
            total += received / samples
    openness = np.zeros(len(vertices))
    directions = rng.standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for direction in directions:
        toward = normals + 0.98 * direction  # cosine-weighted about the normal
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        openness += ~occluded(np.concatenate([start, toward], axis=1).astype(np.float32), 0.8)
    return lamps, sun, world.ambient * (0.15 + 0.85 * openness / len(directions))
