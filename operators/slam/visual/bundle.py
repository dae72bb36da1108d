"""Local bundle adjustment: the newest keyframes of a map and the points that they share, the others held fixed.

Poses and points best explain pixels, depths and the motions between views. Gauss-Newton, reweighted by Cauchy's
function, on all views that are free and all points at once. Triggs et al., "Bundle adjustment, a modern synthesis",
2000; with depths as in Mur-Artal and Tardós, "ORB-SLAM2", 2017.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.estimation.bundle import PosesAndPoints, Sightings, pose_jacobian
from operators.estimation.kernels import cauchy
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3
from operators.geometry.pinhole import Points, project_clamped, projection_jacobian
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter, systematic
from operators.slam import motions
from operators.slam.keyframe_graph import KeyframeGraph
from operators.slam.pose_graph import DenseEdges, Edge
from operators.slam.visual.map_points import MapPoints
from operators.slam.visual.view import View, astray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CAUCHY = 2.0  # residuals of this many sigmas count half
NEAR = 0.1  # metres; nearer points are behind or in the lens
_STILL = 1e-5  # metres and radians: a step less than this ends the iterations
FEWEST = 3  # views of a point; points of two views are covered by the sight between them
MOST = 400  # points
ITERATIONS = 3
PIXEL = 0.5  # working pixels, at least, by which a described feature errs
DEPTH = 0.002  # metres by which its depth errs besides the noise, since it is its patch's
# Of the observations' information, which is believed: features err together from view to view, and the sights and the
# odometry that tie the same keyframes rest on many of the same pixels.
STRENGTH = 0.05
WRONG = 25.0  # squared sigmas of a pixel beyond which a sighting is of something else


@dataclass(frozen=True, eq=False)
class Observations(Sightings):
    """Sightings at pixels (S, 2) of the colour camera with depths (S,) in the depth camera, metres, NaN where unknown;
    and how noisy a pixel is and each depth (S,)."""

    depths: Array
    sigma_pixel: float
    sigma_depths: Array


@dataclass(frozen=True, eq=False)
class Bundle:
    """Poses (W, 4, 4) and points (M, 3) in one frame, and the squared errors (S, 2) of pixels and of depths in sigmas,
    0 for a depth that is unknown."""

    poses: Array
    points: Points
    squared: Array


def adjusted(
    camera: RgbdCamera, poses: Array, points: Points, seen: Observations, edges: Sequence[Edge], fixed: int,
    strength: float, iterations: int,
) -> Bundle:  # fmt: skip
    """Improves depth camera poses (W, 4, 4) after the first `fixed` ones, and points (M, 3).

    `edges` are between these poses; `strength` is the share of the observations' information that is believed, whose
    errors are not independent.
    """
    poses, points = poses.copy(), points.copy()
    graph = DenseEdges(edges, fixed, len(poses))
    solver = _Solver(camera, seen, len(poses), len(points), fixed, strength)
    for _ in range(iterations):
        poses[fixed:], points, step = solver.step(poses, points, graph)
        if step < _STILL:
            break
    poses[fixed:] = se3.orthonormalised(poses[fixed:])
    return Bundle(poses, points, solver.residuals(poses, points)[2])


class _Solver:
    """The observations sorted by point, and what of them stays the same from step to step."""

    def __init__(
        self, camera: RgbdCamera, seen: Observations, poses: int, points: int, fixed: int, strength: float
    ) -> None:
        self.camera, self.seen, self.fixed, self.strength = camera, seen, fixed, strength
        self.count, self.size = poses - fixed, points
        self.known = np.isfinite(seen.depths)
        self.depths = np.where(self.known, seen.depths, 1.0)

    def residuals(self, poses: Array, points: Points) -> tuple[Array, Array, Array, Array]:
        """Returns points in the depth cameras (S, 3), residuals (S, 3) in sigmas, their squares (S, 2), R (S, 3, 3)."""
        seen, K, T_color = self.seen, self.camera.K_color, self.camera.T_color_depth
        p, R = seen.in_cameras(poses, points)
        c = transform_points(T_color, p)
        r = np.empty((len(p), 3))
        r[:, :2] = (project_clamped(c, K, NEAR) - seen.pixels) / seen.sigma_pixel
        r[:, 2] = np.where(self.known, (p[:, 2] - self.depths) / seen.sigma_depths, 0.0)
        squared = np.column_stack([r[:, 0] ** 2 + r[:, 1] ** 2, r[:, 2] ** 2])
        squared[c[:, 2] <= NEAR] = np.inf
        return p, r, squared, R

    def step(self, poses: Array, points: Points, graph: DenseEdges) -> tuple[Array, Points, float]:
        """Returns the free poses and the points after a step, and the largest part of the poses' step."""
        seen, fixed, count, size = self.seen, self.fixed, self.count, self.size
        p, r, squared, R = self.residuals(poses, points)
        w = self.strength * cauchy(squared / CAUCHY**2)
        weights = np.column_stack([w[:, 0], w[:, 0], np.where(self.known, w[:, 1], 0.0)])
        T_color, J = self.camera.T_color_depth, np.zeros((len(p), 3, 3))
        by_color = projection_jacobian(transform_points(T_color, p), self.camera.K_color, NEAR)
        J[:, :2] = by_color / seen.sigma_pixel @ T_color[:3, :3]
        J[:, 2, 2] = 1.0 / seen.sigma_depths
        system = PosesAndPoints(seen.frames - fixed, seen.points, (count, size), pose_jacobian(J, p), J @ R, r, weights)
        system.damp_points(0.0, 1e-6)
        S, g = system.reduced()
        of_edges, pull = graph.normal(poses)
        x = gauss_newton_step(S + of_edges, g + pull)
        points = points + system.points_step(x)
        return poses[fixed:] @ motions.exps(x.reshape(count, 6)), points, float(np.abs(x).max(initial=0.0))


def adjust_newest(graph: KeyframeGraph[View], points: MapPoints, fitter: Fitter, newest: int) -> None:
    """Moves the newest free nodes and the points that they see to where sightings and edges have them together.

    Older nodes that see the same points, or that edges tie to, hold them. Sightings that fit nothing are forgotten.
    """
    free = [k for k in graph.nodes if k not in graph.fixed][-newest:]
    chosen = set(free)
    rows = points.shared(np.array(free, np.int64), FEWEST, MOST)
    of_rows = np.isin(points.sightings.points, rows)
    seen = points.sightings[of_rows]
    edges = [edge for edge in graph.edges if edge.first in chosen or edge.last in chosen]
    ends = {end for edge in edges for end in (edge.first, edge.last)}
    held = sorted((ends | set(seen.nodes.tolist())) - chosen)
    if not len(rows) or not held:
        return
    place = {k: i for i, k in enumerate([*held, *free])}
    known, noise = np.where(np.isfinite(seen.depths), seen.depths, 1.0), fitter.noise
    observed = Observations(
        np.array([place[k] for k in seen.nodes.tolist()], np.int64), np.searchsorted(rows, seen.points),
        seen.pixels, seen.depths, max(PIXEL, noise.pixel),
        np.asarray(noise.depth * fitter.config.depth_noise.sigma(known) + DEPTH, np.float64),
    )  # fmt: skip
    bundle = adjusted(
        fitter.camera, np.array([graph.nodes[k].T for k in place]), points.world(rows, graph.nodes), observed,
        [replace(edge, first=place[edge.first], last=place[edge.last]) for edge in edges], len(held),
        STRENGTH / (systematic(noise.pixel, noise.lasting) * astray(noise)), ITERATIONS,
    )  # fmt: skip
    for k in free:
        graph.nodes[k].T = bundle.poses[place[k]]
    points.move(rows, bundle.points, graph.nodes)
    wrong = of_rows.copy()
    wrong[of_rows] = bundle.squared[:, 0] > WRONG
    points.sightings = points.sightings[~wrong]
