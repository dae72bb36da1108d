"""Views that a map keeps of its places: what a camera is recognised by there, and what its pose is measured against."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix
from operators.monitoring.image_flaws import Watch
from operators.odometry.motion import Motion
from operators.odometry.recognition import Description, match
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter, Sighting
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.relocalizer import lifted
from operators.odometry.rgbd.standing import doubtful, part, standing
from operators.odometry.rgbd.surface import Surface
from operators.slam.visual.guided import guided_pairs
from operators.slam.visual.place_index import rooted

STRIDE = 4  # patches of a surface from one point of the map's cloud to the next
SURE = 0.25  # of the covariance that the odometry's fit claims for a frame, which allows for drift (see the benchmark)
# Working pixels. Tracks that miss by more show colour and depth that are not of one place and time, and then every
# sight errs anew: its variance grows with the fourth power of it.
ASTRAY = 0.45
PIXELS = 3.0  # working pixels by which a recognised feature may be off
FIRST = 8  # features that a first pose may rest on, by which others are looked for
FOUND = 6.0  # working pixels around where a first pose has a feature, in which it is looked for
EXPECTED = 20.0  # the same around where the map has it
PLENTY = 40  # features in agreement that need no others
FLAT = 0.05  # metres by which features of one plane may be off it
TRIPLES = 64  # planes that are tried


@dataclass(frozen=True, eq=False)
class View:
    """Features of a working image: pixels (N, 2), descriptors (N, 128), points (N, 3) in the depth camera, NaN where
    depth is unknown; and the surface that the depth camera saw, with the brightness of every `STRIDE`th patch."""

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points: NDArray[np.float32]
    surface: Surface
    shades: NDArray[np.uint8]

    @staticmethod
    def of(keyframe: Keyframe, camera: RgbdCamera) -> View:
        """Returns the view of a keyframe, whose working image the camera's K_color is of."""
        described = keyframe.description
        points, known = lifted(described.pixels, keyframe.surface, camera)
        patches = transform_points(camera.T_color_depth, keyframe.surface.points(STRIDE))
        u, v = np.rint(project(patches, camera.K_color)).astype(np.int64).T
        height, width = keyframe.gray.shape
        return View(
            described.pixels.astype(np.float32),
            described.descriptors,
            np.where(known[:, None], points, np.nan).astype(np.float32),
            keyframe.surface,
            keyframe.gray[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)],
        )

    @cached_property
    def rooted(self) -> NDArray[np.float32]:
        return rooted(self.descriptors, len(self.descriptors))

    @cached_property
    def steady(self) -> NDArray[np.bool_]:
        """Returns which features (N,) lie on a smooth surface, not on an edge, where either depth may do."""
        known = np.isfinite(self.points[:, 2])
        points = np.where(known[:, None], self.points, np.float32(1.0)).astype(np.float64)
        return np.asarray(known & (self.surface.planes_at(points)[:, 3] != 0), np.bool_)

    @cached_property
    def description(self) -> Description:
        return Description(self.pixels.astype(np.float64), self.descriptors)


@dataclass(frozen=True, eq=False)
class ViewMatch:
    """Holds how a camera's view was measured against a known one, and what supports it.

    `inliers` features agree with the pose, of which `relief` lie off the plane that holds most of them; `overlap` is
    the share of the depth image that the known view could see, `agreement` the share of that which lies on its
    surfaces.
    """

    T_known_seen: Matrix
    covariance: Matrix  # (6, 6), right perturbation
    matched: int
    inliers: int
    relief: int
    overlap: float
    agreement: float


@dataclass(frozen=True)
class Judge:
    """Decides what makes a sight certain enough to correct a map by it.

    `relief` features off one plane make a sight one of its place alone: a floor or a wall whose pattern repeats agrees
    with itself in features and depth where it is shifted by a period.
    """

    inliers: int = 20
    overlap: float = 0.2
    agreement: float = 0.8
    relief: int = 8

    def doubt(self, sight: ViewMatch) -> str:
        """Returns why a sight is not to be believed; nothing for one that is."""
        if sight.inliers < self.inliers:
            return "too few features agree"
        if sight.overlap < self.overlap:
            return "too little of the depth overlaps"
        if sight.agreement < self.agreement:
            return "too little of the depth agrees"
        return ""


def sight(known: View, seen: View, fitter: Fitter, fewest: int, T_expected: Matrix | None = None) -> ViewMatch | None:
    """Measures the pose of a view in the depth camera of a known one; None where fewer than `fewest` features agree.

    RANSAC PnP on matched descriptors; where few agree, on those matched where the map expects them, and once more where
    the first pose puts them; then reprojections and point-to-plane distances together.
    """
    pairs = match(known.description, seen.description)
    sighting, matched = _solved(known, seen, pairs, fitter), len(pairs)
    if T_expected is not None and (sighting is None or len(sighting.pixels) < fewest):
        sighting, matched = _more(sighting, matched, *_guided(known, seen, T_expected, fitter, EXPECTED))
    if sighting is not None and len(sighting.pixels) < PLENTY:
        again = _guided(known, seen, sighting.T_world_camera, fitter, FOUND)
        sighting, matched = _more(sighting, matched, *again)
    if sighting is None or len(sighting.pixels) < fewest:
        return None
    T = sighting.T_world_camera
    fit = fitter.refine(
        _frame(seen, fitter.camera), replace(sighting, recognised=True), Motion(0, T, np.zeros(6)), T, _alone(known), 0
    )
    if fit.inliers < fewest:
        return None
    overlap = fit.compared / fit.offered if fit.offered else 0.0
    return ViewMatch(
        fit.T_world_camera, SURE * astray(fitter.noise) * fit.covariance, matched, fit.inliers,
        relief(sighting.points_world), overlap, fit.depth_inliers,
    )  # fmt: skip


def astray(noise: Noise) -> float:
    """Returns how much larger the variance of a sight is where colour and depth are not of one place and time."""
    return max(1.0, noise.pixel / ASTRAY) ** 4


def _guided(
    known: View, seen: View, T_known_seen: Matrix, fitter: Fitter, window: float
) -> tuple[Sighting | None, int]:
    pairs = guided_pairs(known.points, known.rooted, seen.pixels, seen.rooted, T_known_seen, fitter.camera, window)
    return _solved(known, seen, pairs, fitter), len(pairs)


def _more(a: Sighting | None, matched_a: int, b: Sighting | None, matched_b: int) -> tuple[Sighting | None, int]:
    """Returns the one of two in which more features agree."""
    if b is None or (a is not None and len(a.pixels) >= len(b.pixels)):
        return a, matched_a
    return b, matched_b


def _solved(known: View, seen: View, pairs: NDArray[np.int64], fitter: Fitter) -> Sighting | None:
    points = known.points[pairs[:, 0]].astype(np.float64)
    there = np.isfinite(points[:, 2])
    pixels = seen.pixels[pairs[there, 1]].astype(np.float64)
    found, agree = fitter.consensus(points[there], pixels, np.zeros(len(pixels), np.int64), PIXELS, FIRST)
    return found if found is None else _still(found, known, seen, pairs[there][agree], fitter)


def _still(sighting: Sighting, known: View, seen: View, pairs: NDArray[np.int64], fitter: Fitter) -> Sighting:
    """Returns a sighting without the features of a body that has moved between the views, if depths show one.

    Pixels alone hardly distinguish a step aside with a turn from a robot before a wall that has moved.
    """
    steady = known.steady[pairs[:, 0]] & seen.steady[pairs[:, 1]]
    points, sure = seen.points[pairs[steady, 1]].astype(np.float64), part(sighting, steady)
    if doubtful(sure, points, fitter) < FIRST:
        return sighting
    still = standing(sure, points, fitter, FIRST)
    return still if len(still.contrary) else sighting


def relief(points: NDArray[np.float64]) -> int:
    """Returns how many of points (N, 3) lie off the plane that holds the most of them, of planes through three each."""
    if len(points) < 4:
        return 0
    rng = np.random.default_rng(len(points))
    a, b, c = points[np.array([rng.choice(len(points), 3, replace=False) for _ in range(TRIPLES)])].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    sound = lengths > 1e-9
    if not sound.any():
        return 0
    units = normals[sound] / lengths[sound, None]
    off = np.abs(np.einsum("kj,nj->kn", units, points) - np.einsum("kj,kj->k", units, a[sound])[:, None])
    return int((off > FLAT).sum(axis=1).min())


def _frame(view: View, camera: RgbdCamera) -> Frame:
    nothing = np.zeros((1, 1), np.uint8)
    return Frame(1_000_000_000, nothing, camera.K_color, view.surface.depth, view.surface, None, None, Watch())


def _alone(view: View) -> LocalMap:
    """Returns a map of one view, whose camera is the origin."""
    known = LocalMap(1)
    none = np.zeros((0, 3))
    known.add(
        Keyframe(
            0, np.eye(4), np.zeros((6, 6)), np.zeros((1, 1), np.uint8), view.surface,
            np.zeros((0, 2)), none, np.zeros(0, np.int64),
        )
    )  # fmt: skip
    return known
