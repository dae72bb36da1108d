"""The pose of a frame: solved from its corners, refined by its depth, with what supports it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.perspective import agreed_pose
from operators.geometry.pinhole import Pixels, Points, project
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.motion import Motion
from operators.odometry.rgbd.alignment import Freedom, Normal, PixelTerm, PlaneTerm, PriorTerm, align, drawn_apart
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.noise import AGREED, Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig

# Share of the summed information that is believed. Neighbouring residuals err together (depth noise is smooth
# over several pixels, tracks share motion blur), so they do not average like independent draws.
PLANE_STRENGTH = 0.1
PIXEL_STRENGTH = 0.2
# What variances are of those that the residuals say (calibrated against truth, see the benchmark): the strengths above
# believe too little where all is well. Calibration, rolling shutters and unsynchronised images err alike in every
# residual, so no count averages them out, but tracks then miss by more than they jitter. And what moves by less than a
# gate is wide pulls a pose along by its share of the view, however many residuals there are; it shows as a share of
# the depth and of the tracks that disagree. What draws tracks and depth apart by more than both believe to err by, at
# one keyframe after another, adds up: variances grow with the square of the disagreement that lasts.
SYSTEMATIC = 0.43
JITTER = 0.38  # working pixels; variances grow with the fourth power of what tracks miss by beyond it
CONTESTED = 120.0  # of the product of both shares, and of the square of the gate

ITERATIONS = 300  # of RANSAC, at most
RIVAL = 0.33  # of the tracks that agree: as many that agree on another motion contest it

STAGES = ((4, 0.15, 2), (2, 0.06, 2))  # stride over patches, gate in metres, iterations


def systematic(missed: float, disagreement: float) -> float:
    """Returns how much larger variances are, for what errs alike in all residuals, where tracks miss by so many working
    pixels, and tracks and depth disagree by so much."""
    return _astray(missed) + max(1.0, disagreement / AGREED) ** 2 - 1.0


def alone(missed: float, disagreement: float) -> float:
    """Returns the same of a pose by tracks alone: they differ from depth by so much in what they believe to err by,
    most of which is theirs, since they believe less than depth. Tracks and depth together believe far more."""
    return _astray(missed) + max(1.0, disagreement) - 1.0


def _astray(missed: float) -> float:
    return max(1.0, missed / JITTER) ** 4


@dataclass(frozen=True, eq=False)
class Sighting:
    """World points (N, 3) and where the frame sees them (N, 2), all in agreement with a pose."""

    T_world_camera: Matrix
    points_world: Points
    pixels: Pixels
    ages: NDArray[np.int64]
    tracked: int = 0  # features that were looked for a pose in, those that disagree with this one included
    recognised: bool = False  # by descriptors, so the pose may lie far from the prediction
    contrary: Points = field(default_factory=lambda: np.zeros((0, 3)))  # (M, 3) in the camera: another body's corners

    @property
    def points_camera(self) -> Points:
        """The points (N, 3) in the depth camera."""
        return transform_points(invert(self.T_world_camera), self.points_world)


@dataclass(frozen=True, eq=False)
class Fit:
    """The refined pose and what supports it."""

    T_world_camera: Matrix
    information: Matrix  # (6, 6) of the measurements
    prior: Matrix  # (6, 6) information of the prediction
    inliers: int  # feature tracks
    offered: int  # depth points the frame has, times the reference surfaces
    compared: int  # of these, those that met a reference surface
    agreeing: int  # of these, those that lie on it
    noise: Noise
    missed: float  # working pixels by which this frame's tracks miss; without any, those before
    movers: Movers
    sighting: Sighting | None
    apart: Vector | None = None  # (6,) how tracks and depth are drawn apart, here or else at the keyframe

    @property
    def depth_inliers(self) -> float:
        return self.agreeing / self.compared if self.compared else 0.0

    @property
    def depth_agrees(self) -> bool:
        return self.compared > max(100, 0.1 * self.offered) and self.depth_inliers > 0.5

    @property
    def recognised(self) -> bool:
        return self.sighting is not None and self.sighting.recognised

    @property
    def contested(self) -> float:
        """Share of the depth that disagrees times that of the tracks; where only one can say, its square.

        Descriptors that pair wrongly contradict nothing.
        """
        shares = [1.0 - self.depth_inliers] if self.compared else []
        if self.sighting is not None and self.sighting.tracked and not self.sighting.recognised:
            shares.append(1.0 - self.inliers / self.sighting.tracked)
        return shares[0] * shares[-1] if shares else 0.0

    @property
    def covariance(self) -> Matrix:
        """(6, 6) of the pose against its references, right perturbation: see SYSTEMATIC."""
        gate = max(1.0, self.noise.pixel / JITTER) ** 2
        together = systematic if self.compared else alone
        misfit = together(self.missed, self.noise.lasting) + CONTESTED * gate * self.contested
        return SYSTEMATIC * misfit * np.asarray(np.linalg.inv(self.information + self.prior), np.float64)

    @property
    def weakest_sigma(self) -> float:
        """Standard deviation, in metres or radians, along what the measurements alone determine least."""
        return float(1.0 / np.sqrt(max(np.linalg.eigvalsh(self.information)[0], 1e-12)))


@dataclass(frozen=True, eq=False)
class Fitter:
    """Fits poses of a camera, whose K_color is that of the working image, with the noise learnt so far."""

    camera: RgbdCamera
    config: RgbdOdometryConfig
    noise: Noise

    def solve(
        self, points_world: Points, pixels: Pixels, ages: NDArray[np.int64], threshold: float, fewest: int
    ) -> Sighting | None:
        """Returns the pose that most points agree with, and those that do, if enough do: see `agreed_pose`."""
        return self.consensus(points_world, pixels, ages, threshold, fewest)[0]

    def consensus(
        self, points_world: Points, pixels: Pixels, ages: NDArray[np.int64], threshold: float, fewest: int
    ) -> tuple[Sighting | None, NDArray[np.bool_]]:
        """Returns the pose that most agree with, if enough do, and which (N,) do."""
        none = np.zeros(len(points_world), np.bool_)
        if len(points_world) < fewest:
            return None, none
        found = agreed_pose(points_world, pixels, self.camera.K_color, max(threshold, 1.0), ITERATIONS)
        if found is None:
            return None, none
        T_world_camera = invert(found[0]) @ self.camera.T_color_depth
        chosen = self._agree(T_world_camera, points_world, pixels, threshold)
        if np.count_nonzero(chosen) < fewest:
            return None, none
        return Sighting(T_world_camera, points_world[chosen], pixels[chosen], ages[chosen], len(points_world)), chosen

    def _agree(
        self, T_world_camera: Matrix, points_world: Points, pixels: Pixels, threshold: float
    ) -> NDArray[np.bool_]:
        """Returns which points (N, 3) a pose sees where they were found."""
        T_color_world = self.camera.T_color_depth @ invert(T_world_camera)
        error = project(transform_points(T_color_world, points_world), self.camera.K_color) - pixels
        return np.asarray(np.einsum("ij,ij->i", error, error) < max(threshold, 1.0) ** 2, np.bool_)

    def follow(
        self, points_world: Points, pixels: Pixels, ages: NDArray[np.int64], threshold: float, fewest: int
    ) -> Sighting | None:
        """As `solve`, for tracks: where those that disagree agree on a second motion, the larger surface stands still.

        What moves stands before the world: it may fill most of the image, and yet is smaller than what it hides. Some
        corners agree with both motions, far ones above all, and count for both.
        """
        first, agree = self.consensus(points_world, pixels, ages, threshold, fewest)
        if first is None:
            return None
        rivals = max(fewest, int(RIVAL * len(first.pixels)))
        second = self.solve(points_world[~agree], pixels[~agree], ages[~agree], threshold, rivals)
        if second is None:
            return first
        also = self._agree(second.T_world_camera, points_world, pixels, threshold)
        rival = Sighting(second.T_world_camera, points_world[also], pixels[also], ages[also], len(points_world))
        if _area(first) >= _area(rival):
            return replace(first, contrary=second.points_camera)
        alone = agree & ~also
        return replace(rival, contrary=replace(first, points_world=points_world[alone]).points_camera)

    def refine(
        self,
        frame: Frame,
        sighting: Sighting | None,
        motion: Motion,
        T_predicted: Matrix,
        known: LocalMap,
        segment: int,
    ) -> Fit:
        """Refines a sighting's pose, or else the prediction, against the surfaces of a segment of the map."""
        config = self.config
        spread = motion.spread(frame.stamp, config.acceleration, config.angular_acceleration)
        prior, freedom = PriorTerm(T_predicted, np.diag(1.0 / np.diag(spread))), Freedom.of(spread)
        T, features = T_predicted, list[PixelTerm]()
        if sighting:
            T = sighting.T_world_camera
            if sighting.recognised:
                prior = PriorTerm(T, 1e-3 * np.eye(6))
            features = [self._features(sighting)]
            rough = align(T, features, prior, 4)
            T = rough.T_world_camera
            freedom = Freedom.of(np.asarray(np.linalg.inv(rough.information + prior.information), np.float64))
        references = known.references(T, config.references, segment) if config.refine else []
        shape = frame.surface.inverse_depth.shape
        movers = Movers.none(frame.surface.K, (shape[0], shape[1]))
        stages = ((4, 0.3, 8), *STAGES) if sighting and sighting.recognised else STAGES
        if sighting:
            movers = movers.around(sighting.contrary)
        for stride, gate, iterations in stages:
            points = frame.surface.points(stride)
            points = points[~movers.hold(points)]
            if stride == 2 and sighting and references:
                earlier = [k for k in known.earlier(T, segment) if not any(k is r for r in references)]
                terms = self._planes(points, [*references, *earlier], freedom, gate)
                movers = movers.also(Movers.between(frame.surface.K, (shape[0], shape[1]), points, terms, T))
                points = points[~movers.hold(points)]
            surfaces = self._planes(points, references, freedom, gate)
            alignment = align(T, [*features, *surfaces], prior, iterations)
            T = alignment.T_world_camera
        corners, depth = alignment.normals[: len(features)], alignment.normals[len(features) :]
        noise, missed, apart = self.noise, self.noise.pixel, None
        if sighting and not sighting.recognised:
            noise, apart = self._learnt(corners[0], depth, known.newest.apart)
            missed = self._missed(features[0], corners[0], T, noise)
        return Fit(
            T_world_camera=T,
            information=alignment.information,
            prior=prior.information,
            inliers=sum(part.inliers for part in corners),
            offered=len(points) * len(depth),
            compared=sum(part.seen for part in depth),
            agreeing=sum(part.inliers for part in depth),
            noise=noise,
            missed=missed,
            movers=movers,
            sighting=sighting,
            apart=apart,
        )

    def _features(self, sighting: Sighting) -> PixelTerm:
        sigma = max(1.0, self.noise.pixel) if sighting.recognised else self.noise.pixel
        return PixelTerm(
            sighting.points_world, sighting.pixels, self.camera.K_color, self.camera.T_color_depth,
            sigma, PIXEL_STRENGTH,
        )  # fmt: skip

    def _learnt(self, tracks: Normal, depth: Sequence[Normal], before: Vector | None) -> tuple[Noise, Vector | None]:
        """Returns the noise after a frame's fit, and how its tracks and depth, or else those `before`, are apart."""
        noise = self.noise.after(tracks.median, depth[0].median if depth else None)
        if not sum(part.seen for part in depth):
            return noise, before
        apart = drawn_apart(tracks, sum(depth[1:], depth[0]))
        return noise.disagreed(apart, before), apart

    def _missed(self, term: PixelTerm, tracks: Normal, T_world_camera: Matrix, noise: Noise) -> float:
        """Returns what a frame's tracks miss by, working pixels.

        Depth that draws the pose from where they have it makes them miss by more. Where that does not last, they are
        asked at their own.
        """
        missed = self.noise.missed(tracks.median)
        if noise.lasts == 1.0 or missed < JITTER:
            return missed
        own = T_world_camera @ se3.exp(tracks.step)
        alone = min(missed, self.noise.missed(term.linearise(own).median))
        return float(np.sqrt(alone**2 + noise.lasts * (missed**2 - alone**2)))

    def _planes(self, points: Points, references: Sequence[Keyframe], freedom: Freedom, gate: float) -> list[PlaneTerm]:
        noise, scale = self.config.depth_noise, self.noise.depth
        return [
            PlaneTerm(points, k.surface, k.T_camera_world, noise, scale, freedom, gate, PLANE_STRENGTH)
            for k in references
        ]


def _area(sighting: Sighting) -> float:
    """Returns the surface that corners stand for, up to a factor: they lie evenly over the image."""
    return float((sighting.points_camera[:, 2] ** 2).sum())
