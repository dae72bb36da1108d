"""The rigid motion between two clouds of one scene, from features and then from surfaces, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from dataflow.messages.geometry import transform_points
from operators.cloud.filtering import Voxels
from operators.cloud.fpfh import histograms
from operators.cloud.normals import estimate_normals
from operators.geometry import se3

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


FEWEST = 100  # voxels with a normal that a cloud must have
_MODES = 60  # motions of RANSAC that are compared
_SAME_TURN = 0.98  # cosine of the turn within which motions are like each other
_TRIED = 12  # motions that are refined
_RIVAL = 0.03  # a second motion whose score is that near to the best one's makes the result ambiguous
_CORRELATED = 30.0  # voxels whose errors are alike, for the covariance
_TELLING = 0.03  # share of the surfaces that must face along every direction


@dataclass(frozen=True)
class Settings:
    """Lengths in metres; the others are shares."""

    voxel: float
    trials: int
    min_overlap: float
    min_fitness: float
    max_violation: float


@dataclass(frozen=True, eq=False)
class Prepared:
    """A cloud as needed here: voxels (V, 3) of a size with normals (V, 3), and their features (V, 33) if asked for."""

    points: Array
    normals: Array
    voxel: float

    @classmethod
    def of_cloud(cls, cloud: NDArray[np.float32], voxel: float) -> Prepared:
        points = Voxels.by_size(cloud, voxel).means(cloud) if len(cloud) else np.zeros((0, 3))
        normals = estimate_normals(points, neighbours=24, radius=4 * voxel, viewpoint=np.zeros(3))
        known = np.isfinite(normals).all(axis=1)
        return cls(points[known], normals[known], voxel)

    @cached_property
    def features(self) -> Array:
        if len(self.points) < 2:
            return np.zeros((len(self.points), 33))
        return histograms(self.points, self.normals, 8 * self.voxel, 80)


@dataclass(frozen=True, eq=False)
class Registered:
    """`T` (4, 4) maps the source to the target; `reason` is empty where it is to be believed.

    All but `rmse` (metres) is the worse of both directions: `overlap` is the share of a cloud that the other sensor
    should have seen, `fitness` the share of that which lies on the other cloud, `violation` the share of it that hangs
    in what the other sensor saw to be free. `covariance` (6, 6) is of a right perturbation (translation, rotation).
    """

    T: Array
    overlap: float
    fitness: float
    rmse: float
    violation: float
    covariance: Array
    reason: str

    @property
    def score(self) -> float:
        """The measures by which motions are compared."""
        return self.fitness - self.violation

    def refused(self, reason: str) -> Registered:
        """Returns the same, not to be believed."""
        return replace(self, reason=reason)


def register(source: Prepared, target: Prepared, settings: Settings, rng: np.random.Generator) -> Registered:
    """Returns the motion from source to target, without a guess: FPFH matches, RANSAC, then generalised ICP.

    Segal, Haehnel and Thrun, "Generalized-ICP", 2009, by small_gicp with one thread. Several motions are refined, and
    where two of them explain the clouds as well, neither is believed.
    """
    if min(len(source.points), len(target.points)) < FEWEST:
        return failure(f"fewer than {FEWEST} voxels with a normal")
    pairs = _matches(source.features, target.features)
    starts = _starts(source.points[pairs[:, 0]], target.points[pairs[:, 1]], settings, rng)
    if not starts:
        return failure("no motion agrees with the features")
    tree = cKDTree(target.points)
    starts.sort(key=lambda T: -_agreement(source, target, tree, T, 3 * settings.voxel))
    tried: list[Registered] = []
    for T in starts:
        if len(tried) < _TRIED and not any(_led_by(T, found.T, settings.voxel) for found in tried):
            tried.append(refine(source, target, T, settings))
    tried.sort(key=lambda found: (bool(found.reason), -found.score))
    best = tried[0]
    for other in tried[1:]:
        near = other.score > best.score - _RIVAL and other.overlap > 0.7 * best.overlap
        if not best.reason and near and apart(best.T, other.T, settings.voxel):
            return best.refused("ambiguous: another motion explains the clouds as well")
    return best


def refine(source: Prepared, target: Prepared, guess: Array, settings: Settings) -> Registered:
    """Returns the motion near a guess by generalised ICP, with what speaks for it."""
    T = guess
    for reach in (6 * settings.voxel, 3 * settings.voxel):
        found = small_gicp.align(
            target.points, source.points, init_T_target_source=T, registration_type="GICP",
            downsampling_resolution=settings.voxel / 2, max_correspondence_distance=reach, num_threads=1,
            max_iterations=40,
        )  # fmt: skip
        T = np.asarray(found.T_target_source)
    said = explained(source, target, T, settings)
    reason = said.reason
    if not reason and not _told(source, target, T, settings.voxel):
        reason = "degenerate: the shared surfaces leave a direction free"
    rotation_last = [3, 4, 5, 0, 1, 2]  # small_gicp has rotation first
    information = found.H[np.ix_(rotation_last, rotation_last)] + 1e-9 * np.eye(6)
    return replace(said, covariance=np.linalg.inv(information) * _CORRELATED, reason=reason)


def explained(source: Prepared, target: Prepared, T: Array, settings: Settings) -> Registered:
    """Returns what speaks for a motion; its covariance is not known."""
    one = _explained(transform_points(T, source.points), target.points, settings.voxel)
    two = _explained(transform_points(np.linalg.inv(T), target.points), source.points, settings.voxel)
    overlap, fitness = min(one[0], two[0]), min(one[1], two[1])
    violation, rmse = max(one[2], two[2]), max(one[3], two[3])
    reason = ""
    if overlap < settings.min_overlap:
        reason = f"the clouds share {overlap:.0%}"
    elif fitness < settings.min_fitness:
        reason = f"{fitness:.0%} of what both saw agree"
    elif violation > settings.max_violation:
        reason = f"{violation:.0%} lie where the other sensor saw nothing"
    return Registered(T, overlap, fitness, rmse, violation, np.full((6, 6), np.nan), reason)


def failure(reason: str) -> Registered:
    """Returns that there is no motion."""
    return Registered(np.eye(4), 0.0, 0.0, float("nan"), 0.0, np.full((6, 6), np.nan), reason)


def _explained(moved: Array, seen: Array, voxel: float) -> tuple[float, float, float, float]:
    """Returns overlap, fitness, violation and RMSE of points in the frame of another cloud."""
    distance, _ = cKDTree(seen).query(moved, distance_upper_bound=4 * voxel)
    on = distance <= 1.5 * voxel
    visible = _visible(moved, seen) | on
    fitness = float((on & visible).sum() / max(1, visible.sum()))
    rmse = float(np.sqrt(np.square(distance[on]).mean())) if on.any() else float("nan")
    return float(visible.mean()), fitness, _violation(moved, seen), rmse


def _told(source: Prepared, target: Prepared, T: Array, voxel: float) -> bool:
    """Returns whether the surfaces that both clouds show face along every direction, and about every axis."""
    moved = transform_points(T, source.points)
    distance, index = cKDTree(target.points).query(moved, distance_upper_bound=1.5 * voxel)
    near = np.isfinite(distance)
    points, normals = moved[near], target.normals[index[near]]
    centred = points - points.mean(axis=0)
    arms = np.cross(centred, normals)
    _, axes = np.linalg.eigh(arms.T @ arms)
    # Over the points' distance from each axis: what is long is thin about its length.
    aside = np.square(centred).sum(axis=1, keepdims=True) - np.square(centred @ axes)
    turning = arms @ axes / np.sqrt(np.maximum(aside.mean(axis=0), 1e-12))
    moving = normals @ np.linalg.eigh(normals.T @ normals)[1]
    return not any((np.where(np.abs(x) > 0.3, x**2, 0).mean(axis=0) < _TELLING).any() for x in (moving, turning))


def apart(A: Array, B: Array, voxel: float) -> bool:
    """Tells whether two motions are different ones."""
    off = se3.log(np.linalg.inv(A) @ B)
    return bool(np.linalg.norm(off[:3]) > 4 * voxel or np.linalg.norm(off[3:]) > 0.1)


def _led_by(start: Array, found: Array, voxel: float) -> bool:
    """Tells whether a start is so near to a motion that it would lead to it again."""
    off = se3.log(np.linalg.inv(start) @ found)
    return bool(np.linalg.norm(off[:3]) < 10 * voxel and np.linalg.norm(off[3:]) < 0.35)


_CELL = 0.03  # radians, of the panorama in which sight lines are compared
_AROUND = int(2 * np.pi / _CELL) + 1  # cells around it


def _panorama(points: Array) -> tuple[Indices, Array]:
    """Returns the cell of each point's direction and its distance from the origin."""
    distance = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    cell = np.floor((azimuth + np.pi) / _CELL).astype(np.int64) * 256 + np.floor((elevation + 2) / _CELL).astype(
        np.int64
    )
    return cell.astype(np.intp), distance


def _sight(points: Array) -> Array:
    """Returns how far the sensor at the origin saw at least, per cell of the panorama; 0 where it saw nothing."""
    cell, distance = _panorama(points)
    nearest = np.full(256 * 256, np.inf)
    np.minimum.at(nearest, cell, distance)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def _visible(moved: Array, seen: Array) -> NDArray[np.bool_]:
    cell, distance = _panorama(moved)
    sight = _sight(seen)[cell]
    return np.asarray((sight > 0) & (distance <= sight + 0.3))


def _violation(moved: Array, seen: Array) -> float:
    """Returns the share of points that hang before what the sensor at the origin saw in and around their direction.

    Around, since beams pass beside what is thin and beside edges: something that hangs there stands before all of them.
    """
    cell, distance = _panorama(moved)
    sight = _sight(seen)
    known = sight[cell] > 0
    if known.sum() < 50:
        return 1.0
    free = _free(sight)[cell]
    return float((known & (distance < 0.92 * free - 0.1)).sum() / known.sum())


def _free(sight: Array) -> Array:
    """Returns the least of the sights in each cell of the panorama and in those around it that have one."""
    grid = np.where(sight > 0, sight, np.inf).reshape(256, 256)[:_AROUND]
    wrapped = np.concatenate([grid[-1:], grid, grid[:1]])
    free = np.full((256, 256), np.inf)
    free[:_AROUND] = minimum_filter(wrapped, size=3, mode="nearest")[1:-1]
    return np.asarray(free.ravel())


def _matches(source: Array, target: Array) -> Indices:
    """Returns pairs (M, 2) of features that are each other's nearest."""
    forward = cKDTree(target).query(source)[1]
    backward = cKDTree(source).query(target)[1]
    own = np.arange(len(source))
    mutual = backward[forward] == own
    return np.column_stack([own[mutual], forward[mutual]])


def _starts(source: Array, target: Array, settings: Settings, rng: np.random.Generator) -> list[Array]:
    """Returns motions with most matches in agreement, best first: RANSAC on triples whose sides are equally long."""
    if len(source) < 4:
        return []
    triples = rng.integers(0, len(source), (settings.trials, 3))
    fits = np.ones(settings.trials, np.bool_)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        one = np.linalg.norm(source[triples[:, a]] - source[triples[:, b]], axis=1)
        two = np.linalg.norm(target[triples[:, a]] - target[triples[:, b]], axis=1)
        fits &= (np.abs(one - two) <= 2 * settings.voxel) & (one > 6 * settings.voxel)
    triples = triples[fits][:2000]
    motions = _rigid(source[triples], target[triples])
    votes = np.zeros(len(motions), np.int64)
    for k, T in enumerate(motions):
        votes[k] = (np.linalg.norm(transform_points(T, source) - target, axis=1) <= 2.5 * settings.voxel).sum()
    order = np.argsort(-votes, kind="stable")
    return _modes(motions[order[votes[order] >= 4]], 5 * settings.voxel)


def _modes(motions: Array, near: float) -> list[Array]:
    """Returns motions (4, 4) that are apart, of (K, 4, 4) in their order: each stands for all that are like it.

    A room that looks alike from both ends has many triples for one of two motions, and both are to be tried.
    """
    found: list[Array] = []
    while len(motions) and len(found) < _MODES:
        best = motions[0]
        found.append(best)
        cosine = (np.einsum("kij,ij->k", motions[:, :3, :3], best[:3, :3]) - 1) / 2
        away = np.linalg.norm(motions[:, :3, 3] - best[:3, 3], axis=1)
        motions = motions[(away > near) | (cosine < _SAME_TURN)]
    return found


def _rigid(source: Array, target: Array) -> Array:
    """Returns the motions (K, 4, 4) of triples (K, 3, 3). Umeyama, 1991."""
    a, b = source.mean(axis=1, keepdims=True), target.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("kni,knj->kij", target - b, source - a))
    flip = np.ones((len(source), 3))
    flip[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    R = (u * flip[:, None, :]) @ vt
    T = np.tile(np.eye(4), (len(source), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = b[:, 0] - np.einsum("kij,kj->ki", R, a[:, 0])
    return T


def _agreement(source: Prepared, target: Prepared, tree: cKDTree, T: Array, reach: float) -> float:
    """Returns the share of the source that lies on the target with the same normal, less what hangs in free space."""
    moved = transform_points(T, source.points)
    distance, index = tree.query(moved, distance_upper_bound=reach)
    near = np.isfinite(distance)
    normals = source.normals @ T[:3, :3].T
    same = np.einsum("ij,ij->i", normals[near], target.normals[index[near]]) > 0.7
    return float(same.sum() / len(moved)) - _violation(moved, target.points)
