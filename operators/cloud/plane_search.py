"""Searches planes along and across gravity in a cloud, by random sampling with a known direction of up.

The up direction leaves one number open for a level plane and two for an upright one, so a sample is one point or two:
few trials find each plane, and the noise of normals decides only which points vote. Fischler and Bolles, "Random sample
consensus", 1981; voting by normals as in Schnabel, Wahl and Klein, "Efficient RANSAC", 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from operators.cloud.clustering import connected, level_axes
from operators.cloud.filtering import Voxels
from operators.cloud.normals import estimate_normals

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Kind = Literal["level", "upright"]

ASKEW = math.radians(6)  # a plane so near to the direction of walls has it
_ELECTORATE = 2000  # so many points are enough to find the best of the samples; all fit the plane afterwards


@dataclass(frozen=True)
class Search:
    """Settings of the search for planes. Lengths in metres, angles in radians."""

    voxel: float
    """Side of the voxels whose means stand for the cloud."""
    distance: float
    """A point this near to a plane is on it..."""
    growth: float
    """...plus this times its squared distance from the sensor: the noise of a depth camera. 1/m."""
    normal_angle: float
    """Who votes for a plane has a normal within this of the plane's."""
    tilt: float
    """A plane leans by no more than this from level or upright."""
    gap: float
    """Parts of a level plane farther apart than this are separate planes."""
    min_area: float
    """Smallest area that makes a plane, m²."""
    trials: int
    """Random samples per plane."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane n·p + d = 0 with the voxels on it; `normal` (3,) faces the sensor."""

    kind: Kind
    normal: Array
    d: float
    members: Indices
    area: float

    def distances(self, points: Array) -> Array:
        """Returns signed distances (N,), above 0 on the sensor's side."""
        return np.asarray(points @ self.normal + self.d)


@dataclass(frozen=True, eq=False)
class Scene:
    """The cloud as voxels: `points` (V, 3) and `normals` (V, 3) with the sensor at the origin, `tolerance` (V,)."""

    points: Array
    normals: Array
    tolerance: Array
    up: Array
    of: Indices

    @classmethod
    def of_cloud(cls, cloud: NDArray[np.float32], up: Array, search: Search) -> Scene:
        """`cloud` (N, 3) is finite, `up` (3,) a unit vector; `of` (N,) is the voxel of each point."""
        voxels = Voxels.by_size(cloud, search.voxel)
        points = voxels.means(cloud)
        normals = estimate_normals(points, neighbours=24, radius=6 * search.voxel, viewpoint=np.zeros(3))
        return cls(points, normals, tolerances(points, search), up, voxels.of)


def tolerances(points: Array, search: Search) -> Array:
    """Returns how far (N,) from a plane a point of that plane may lie."""
    return np.asarray(search.distance + search.growth * np.einsum("ij,ij->i", points, points))


def find_planes(scene: Scene, search: Search, rng: np.random.Generator, walls: Array | None = None) -> list[Plane]:
    """Returns level planes, then upright ones, in the order in which they were found; a voxel is on one at most.

    Where the directions of `walls` (2, 3) are known, upright planes across them are looked for before all others: what
    leans against a wall, such as a door that stands ajar, is then no part of one plane with it.
    """
    lean = np.abs(scene.normals @ scene.up)
    sine, cosine = math.sin(search.normal_angle), math.cos(search.normal_angle)
    free = np.ones(len(scene.points), np.bool_)
    planes: list[Plane] = []
    planes += _planes_of_kind(scene, search, "level", lean >= cosine, free, rng)
    if walls is not None:
        planes += _planes_of_kind(scene, search, "upright", lean <= sine, free, rng, walls)
    planes += _planes_of_kind(scene, search, "upright", lean <= sine, free, rng)
    return planes


def _planes_of_kind(
    scene: Scene,
    search: Search,
    kind: Kind,
    voters: Mask,
    free: Mask,
    rng: np.random.Generator,
    across: Array | None = None,
) -> list[Plane]:
    """Takes planes, best first, until none is large enough; takes their voxels from `free`.

    Those `across` directions (2, 3) keep their direction while their voxels are found, and have it within `ASKEW` then.
    """
    planes: list[Plane] = []
    may_vote = voters.copy()
    fewest = max(8, math.ceil(search.min_area / (4 * search.voxel**2)))
    while True:
        index = np.flatnonzero(may_vote & free)
        if len(index) < fewest:
            return planes
        normal, d = _best_sample(scene, search, kind, index, rng, across)
        normal, d, on = _refined(scene, search, kind, index, normal, d, across is not None)
        if len(on) < fewest:
            return planes
        parts = _parts(scene.points[on], search.gap if kind == "level" else 3 * search.gap)
        may_vote[on] = False
        for part in range(parts.max() + 1):
            members = on[parts == part]
            area = covered_area(scene.points[members], normal, 2 * search.voxel)
            if area < search.min_area:
                continue
            if across is not None and _least_squares(scene, members, normal)[0] @ normal < math.cos(ASKEW):
                continue
            own_normal, own_d = _fitted(scene, kind, members, normal, d, search.tilt)
            members = _absorbed(scene, free, members, own_normal, own_d, 2 * search.voxel)
            free[members] = False
            planes.append(Plane(kind, *_facing(own_normal, own_d), members, area))


def _best_sample(
    scene: Scene, search: Search, kind: Kind, index: Indices, rng: np.random.Generator, across: Array | None
) -> tuple[Array, float]:
    """Returns the sampled plane with the most votes."""
    index = index[:: 1 + len(index) // _ELECTORATE]
    points, tolerance, normals = scene.points[index], scene.tolerance[index], scene.normals[index]
    if kind == "level":
        picked = rng.integers(0, len(index), search.trials)
        candidates = np.repeat(scene.up[None], search.trials, axis=0)
    elif across is not None:
        picked = rng.integers(0, len(index), search.trials)
        candidates = across[np.arange(search.trials) % len(across)]
    else:
        pairs = rng.integers(0, len(index), (search.trials, 2))
        along = points[pairs[:, 1]] - points[pairs[:, 0]]
        candidates = np.cross(along, scene.up)
        length = np.linalg.norm(candidates, axis=1)
        usable = length > 4 * search.voxel
        candidates = candidates[usable] / length[usable, None]
        picked = pairs[usable, 0]
        if not len(picked):
            picked, candidates = np.zeros(1, np.intp), _level_part(normals[:1], scene.up)
    offsets = np.einsum("ij,ij->i", points[picked], candidates)
    near = np.abs(candidates @ points.T - offsets[:, None]) <= tolerance
    near &= np.abs(candidates @ normals.T) >= math.cos(search.normal_angle)
    best = int(near.sum(axis=1).argmax())
    return candidates[best], -float(offsets[best])


def _refined(
    scene: Scene, search: Search, kind: Kind, index: Indices, normal: Array, d: float, keeps_normal: bool
) -> tuple[Array, float, Indices]:
    """Fits the plane to its voters and finds these again, a few times; only its place if it `keeps_normal`."""
    on = index
    for _ in range(4):
        near = np.abs(scene.points[index] @ normal + d) <= scene.tolerance[index]
        near &= np.abs(scene.normals[index] @ normal) >= math.cos(search.normal_angle)
        on = index[near]
        if len(on) < 3:
            break
        if keeps_normal:
            weights = scene.tolerance[on] ** -2
            d = -float(weights @ (scene.points[on] @ normal) / weights.sum())
        else:
            normal, d = _fitted(scene, kind, on, normal, d, search.tilt)
    return normal, d, on


def _fitted(scene: Scene, kind: Kind, members: Indices, normal: Array, d: float, tilt: float) -> tuple[Array, float]:
    """Returns the plane of least squares through the members, weighted by their noise; the old one if it leans."""
    fitted, middle = _least_squares(scene, members, normal)
    lean = abs(float(fitted @ scene.up))
    leans = lean < math.cos(tilt) if kind == "level" else lean > math.sin(tilt)
    if leans or fitted @ normal < math.cos(2 * tilt):
        return normal, -float(middle @ normal)
    return fitted, -float(middle @ fitted)


def _least_squares(scene: Scene, members: Indices, normal: Array) -> tuple[Array, Array]:
    """Returns the normal (3,) that fits the members, on the side of `normal`, and their middle (3,)."""
    weights = scene.tolerance[members] ** -2
    weights = weights / weights.sum()
    middle = weights @ scene.points[members]
    offset = scene.points[members] - middle
    _, axes = np.linalg.eigh((offset * weights[:, None]).T @ offset)
    return axes[:, 0] * (1.0 if axes[:, 0] @ normal >= 0 else -1.0), middle


def _parts(points: Array, gap: float) -> NDArray[np.int32]:
    """Returns the number of the connected part of each point; points nearer than `gap` are connected."""
    return connected(cKDTree(points).query_pairs(gap / 2, output_type="ndarray"), len(points))


def _absorbed(scene: Scene, free: Mask, members: Indices, normal: Array, d: float, reach: float) -> Indices:
    """Returns the members and the free voxels beside them that are as near to the plane, whatever their normal."""
    others = free.copy()
    others[members] = False
    close = np.flatnonzero(others & (np.abs(scene.points @ normal + d) <= 1.5 * scene.tolerance))
    if not len(close):
        return members
    distance, _ = cKDTree(scene.points[members]).query(scene.points[close], distance_upper_bound=reach)
    return np.sort(np.concatenate([members, close[np.isfinite(distance)]]))


def covered_area(points: Array, normal: Array, cell: float) -> float:
    """Returns the area of the cells of a square grid in the plane that hold points, m²."""
    column, row = np.floor(points @ level_axes(normal).T / cell).astype(np.int64).T
    return len(np.unique((column << 32) + row)) * cell * cell


def _level_part(normals: Array, up: Array) -> Array:
    flat = normals - (normals @ up)[:, None] * up
    return np.asarray(flat / np.linalg.norm(flat, axis=1, keepdims=True))


def _facing(normal: Array, d: float) -> tuple[Array, float]:
    """Returns the plane with its normal towards the origin, where the sensor is."""
    return (normal, d) if d >= 0 else (-normal, -d)
