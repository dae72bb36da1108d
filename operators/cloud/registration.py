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
from operators.cloud.motion_search import matches, motions
from operators.cloud.normals import estimate_normals
from operators.geometry import se3
from operators.geometry.facing import LEANS, free_directions

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


FEWEST = 100  # voxels with a normal that a cloud must have
_TRIED = 12  # motions that are refined
_RIVAL = 0.03  # a second motion whose score is that near to the best one's makes the result ambiguous
_LESS_FITNESS, _MORE_VIOLATION = 0.02, 0.01  # that are asked for where the score is sure
_CONTRADICTS = 3.0  # times what lies on the other cloud counts what hangs in free space
_ALIKE = 0.8  # cosine between normals of one surface
_CORRELATED = 30.0  # voxels whose errors are alike, for the covariance
_TELLING = 0.03  # share of the surfaces that must face along every direction


@dataclass(frozen=True)
class Settings:
    """Lengths in metres; the others are shares.

    Scores are of `Registered`: none below `min_score` is believed, and a `sure_score` makes up for a little of fitness
    and violation.
    """

    voxel: float
    trials: int
    min_overlap: float
    min_fitness: float
    max_violation: float
    min_score: float = -np.inf
    sure_score: float = np.inf


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
    in what the other sensor saw to be free, `agreement` the share that lies in the other cloud's surfaces. `settled`
    is True where the shared surfaces leave no direction free. `covariance` (6, 6) is of a right perturbation
    (translation, rotation).
    """

    T: Array
    overlap: float
    fitness: float
    rmse: float
    violation: float
    agreement: float
    settled: bool
    covariance: Array
    reason: str

    @property
    def score(self) -> float:
        """The measure by which motions are compared."""
        return self.agreement - _CONTRADICTS * self.violation

    def rivals(self, best: Registered, voxel: float) -> bool:
        """Returns whether this is another motion than the best, and explains the clouds as well.

        Less of the clouds is explained more easily, and most easily by surfaces that leave a direction free.
        """
        shared = 0.7 if self.settled else 0.9
        return (
            self.score > best.score - _RIVAL and self.overlap > shared * best.overlap and apart(best.T, self.T, voxel)
        )

    def refused(self, reason: str) -> Registered:
        """Returns the same, not to be believed."""
        return replace(self, reason=reason)


def register(source: Prepared, target: Prepared, settings: Settings, rng: np.random.Generator) -> Registered:
    """Returns the motion from source to target, without a guess: matches of FPFH that agree, then generalised ICP.

    Segal, Haehnel and Thrun, "Generalized-ICP", 2009, by small_gicp with one thread. Several motions are refined, and
    where two of them explain the clouds as well, neither is believed.
    """
    if min(len(source.points), len(target.points)) < FEWEST:
        return failure(f"fewer than {FEWEST} voxels with a normal")
    one, two = matches(source.features, target.features).T
    starts = motions(
        (source.points[one], source.normals[one]),
        (target.points[two], target.normals[two]),
        settings.voxel,
        settings.trials,
        rng,
    )
    if not starts:
        return failure("no motion agrees with the features")
    tree = cKDTree(target.points)
    starts.sort(key=lambda T: -_agreement(source, target, tree, T, 3 * settings.voxel))
    tried: list[Registered] = []
    for T in starts:
        if len(tried) < _TRIED and not any(_led_by(T, found.T, settings.voxel) for found in tried):
            tried.append(refine(source, target, T, settings))
    return best_of(tried, settings.voxel)


def best_of(tried: list[Registered], voxel: float) -> Registered:
    """Returns the motion that explains most, refused where another one explains the clouds as well."""
    best, *others = sorted(tried, key=lambda found: (bool(found.reason), -found.score))
    if not best.reason and any(other.rivals(best, voxel) for other in others):
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
    rotation_last = [3, 4, 5, 0, 1, 2]  # small_gicp has rotation first
    information = found.H[np.ix_(rotation_last, rotation_last)] + 1e-9 * np.eye(6)
    said = explained(source, target, T, settings)
    reason = said.reason
    if not reason and not said.settled:
        reason = "degenerate: the shared surfaces leave a direction free"
    return replace(said, covariance=np.linalg.inv(information) * _CORRELATED, reason=reason)


def explained(source: Prepared, target: Prepared, T: Array, settings: Settings) -> Registered:
    """Returns what speaks for a motion; its covariance is not known."""
    one, two = _Seen.of(source, target, T), _Seen.of(target, source, np.asarray(np.linalg.inv(T), np.float64))
    overlap, fitness = min(one.overlap, two.overlap), min(one.fitness, two.fitness)
    violation, settled = max(one.violation, two.violation), one.settled
    agreement, rmse = min(one.agreement, two.agreement), max(one.rmse, two.rmse)
    unknown = np.full((6, 6), np.nan)
    found = Registered(T, overlap, fitness, rmse, violation, agreement, settled, unknown, "")
    return found.refused(_doubt(found, settings))


def _doubt(found: Registered, settings: Settings) -> str:
    """Returns why a motion is not to be believed; empty where it is."""
    sure = found.score >= settings.sure_score
    if found.overlap < settings.min_overlap:
        return f"the clouds share {found.overlap:.0%}"
    if found.fitness < settings.min_fitness - (_LESS_FITNESS if sure else 0):
        return f"{found.fitness:.0%} of what both saw agree"
    if found.violation > settings.max_violation + (_MORE_VIOLATION if sure else 0):
        return f"{found.violation:.0%} lie where the other sensor saw nothing"
    if found.score < settings.min_score:
        return f"{found.agreement:.0%} of what both saw lie in surfaces that agree"
    return ""


def failure(reason: str) -> Registered:
    """Returns that there is no motion."""
    return Registered(np.eye(4), 0.0, 0.0, float("nan"), 0.0, 0.0, False, np.full((6, 6), np.nan), reason)


@dataclass(frozen=True)
class _Seen:
    """A cloud as another sensor should have seen it; see `Registered`."""

    overlap: float
    fitness: float
    rmse: float
    violation: float
    agreement: float
    settled: bool

    @classmethod
    def of(cls, cloud: Prepared, other: Prepared, T: Array) -> _Seen:
        """Compares a cloud, moved by T (4, 4), with the other one."""
        voxel = other.voxel
        moved = transform_points(T, cloud.points)
        distance, index = cKDTree(other.points).query(moved, distance_upper_bound=1.5 * voxel)
        on = np.isfinite(distance)
        visible = _visible(moved, other.points) | on
        surface = other.normals[index[on]]
        off = np.abs(np.einsum("ij,ij->i", moved[on] - other.points[index[on]], surface))
        alike = np.einsum("ij,ij->i", cloud.normals[on] @ T[:3, :3].T, surface) > _ALIKE
        return cls(
            overlap=float(visible.mean()),
            fitness=float(on.sum() / max(1, visible.sum())),
            rmse=float(np.sqrt(np.square(distance[on]).mean())) if on.any() else float("nan"),
            violation=_violation(moved, other.points, on),
            agreement=float((alike & (off < 0.5 * voxel)).sum() / max(1, visible.sum())),
            settled=bool(on.any()) and _settled(moved[on], surface),
        )


def _settled(points: Array, normals: Array) -> bool:
    """Returns whether surfaces face along every direction, and about every axis."""
    centred = points - points.mean(axis=0)
    arms = np.cross(centred, normals)
    _, axes = np.linalg.eigh(arms.T @ arms)
    # Over the points' distance from each axis: what is long is thin about its length.
    aside = np.square(centred).sum(axis=1, keepdims=True) - np.square(centred @ axes)
    turning = arms @ axes / np.sqrt(np.maximum(aside.mean(axis=0), 1e-12))
    told = np.where(np.abs(turning) > LEANS, turning**2, 0).mean(axis=0)
    return not len(free_directions(normals, _TELLING)) and not bool((told < _TELLING).any())


def apart(A: Array, B: Array, voxel: float) -> bool:
    """Returns whether two motions are different ones."""
    off = se3.log(np.linalg.inv(A) @ B)
    return bool(np.linalg.norm(off[:3]) > 4 * voxel or np.linalg.norm(off[3:]) > 0.1)


def _led_by(start: Array, found: Array, voxel: float) -> bool:
    """Returns whether a start is so near to a motion that it would lead to it again."""
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


def _violation(moved: Array, seen: Array, on: NDArray[np.bool_]) -> float:
    """Returns the share of points that hang before what the sensor at the origin saw in and around their direction.

    Around, since beams pass beside what is thin and beside edges: something that hangs there stands before all of them.
    Points `on` what it saw contradict nothing, however flat they are seen.
    """
    cell, distance = _panorama(moved)
    sight = _sight(seen)
    known = sight[cell] > 0
    if known.sum() < 50:
        return 1.0
    free = _free(sight)[cell]
    return float((known & ~on & (distance < 0.92 * free - 0.1)).sum() / known.sum())


def _free(sight: Array) -> Array:
    """Returns the least of the sights in each cell of the panorama and in those around it that have one."""
    grid = np.where(sight > 0, sight, np.inf).reshape(256, 256)[:_AROUND]
    wrapped = np.concatenate([grid[-1:], grid, grid[:1]])
    free = np.full((256, 256), np.inf)
    free[:_AROUND] = minimum_filter(wrapped, size=3, mode="nearest")[1:-1]
    return np.asarray(free.ravel())


def _agreement(source: Prepared, target: Prepared, tree: cKDTree, T: Array, reach: float) -> float:
    """Returns the share of the source that lies on the target with the same normal, less what hangs in free space."""
    moved = transform_points(T, source.points)
    distance, index = tree.query(moved, distance_upper_bound=reach)
    near = np.isfinite(distance)
    normals = source.normals @ T[:3, :3].T
    same = np.einsum("ij,ij->i", normals[near], target.normals[index[near]]) > 0.7
    return float(same.sum() / len(moved)) - _violation(moved, target.points, near)
