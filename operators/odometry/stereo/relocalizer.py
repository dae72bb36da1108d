"""Finds the view of a lost stereo camera among pairs that were kept, by the search of an RGB-D camera.

Pairs are kept reduced, and their dense depth and features are made when a lost camera first asks for them. The
search, and its judgement of a view, is made for rooms: distances that agree do so within centimetres. In a street they
cannot, and need not, so everything is brought to a scene whose things are typically `TYPICAL` away.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.depth.stereo_matching import MatchingConfig, StereoMatcher
from operators.geometry.se3 import Matrix
from operators.monitoring.image_flaws import Flaw, Watch
from operators.odometry.features import Gray
from operators.odometry.images import reduced
from operators.odometry.motion import Motion
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.relocalizer import believed, recognised
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import DepthNoise, Surface, scaled_intrinsics
from operators.odometry.stereo.adjustment import StereoRig
from operators.odometry.tracking import scaled_covariance

WIDTH = 320  # images are reduced by whole factors to no less than this
TYPICAL = 2.0  # units that things of a scene are typically away
NEAREST = 0.3  # share of the typical depth: what is nearer has none
SIGMA = 0.3  # of a dense disparity, reduced pixels
SUREST = 10.0  # disparities of fewer standard deviations say no depth
COVERAGE = 0.01  # share of a view that must have a depth


@dataclass(frozen=True, eq=False)
class StereoKeyframe:
    """A pair, reduced by a whole factor, the pose that it was given, and by how much right columns were off there."""

    stamp: int
    T_world_camera: Matrix
    covariance: Matrix  # (6, 6) of that pose, right perturbation
    left: Gray
    right: Gray
    factor: int
    offset: float  # pixels before the reduction
    segment: int = 0  # maps begun before this one after a loss; two segments share no known motion


@dataclass(frozen=True, eq=False)
class RelocalizedPose:
    """A pose of a view in metres, its covariance (6, 6) against the keyframe that it was found by, and its features."""

    T_world_camera: Matrix
    covariance: Matrix
    features: int
    keyframe: StereoKeyframe


def kept_pair(
    left: Gray, right: Gray, stamp: int, T_world_camera: Matrix, covariance: Matrix, offset: float, segment: int
) -> StereoKeyframe:
    """Reduces a pair to what is kept of it."""
    factor = max(1, left.shape[1] // WIDTH)
    small = reduced(left, factor), reduced(right, factor)
    return StereoKeyframe(stamp, T_world_camera, covariance, *small, factor, offset, segment)


class StereoRelocalizer:
    """Compares a view with keyframes of one rig, in units of which a typical depth of the scene has `TYPICAL`.

    What it makes of keyframes it keeps, as long as they are asked about; it depends on nothing else.
    """

    def __init__(self, rig: StereoRig) -> None:
        self.rig = rig
        self._made: dict[int, tuple[StereoKeyframe, float, Keyframe]] = {}

    def found(
        self, view: StereoKeyframe, chosen: Sequence[StereoKeyframe], known: Sequence[StereoKeyframe], unit: float
    ) -> Iterator[RelocalizedPose]:
        """Yields the poses of a view among chosen keyframes of those known that all that is seen makes sure of.

        `unit`: metres. The pose that the view was given does not count.
        """
        frame, there = self._frame(view, unit), LocalMap(len(known))
        there.keyframes = self._keyframes(known, unit)
        wanted = {k.stamp for k in chosen}
        motion = Motion(view.stamp - 1, np.eye(4), np.zeros(6))
        fitter = self._fitter(view, unit)
        among = [k for k in there.keyframes if k.stamp in wanted]
        for fit, keyframe in recognised(frame, among, fitter, motion, np.eye(4), there):
            by = next(k for k in known if k.stamp == keyframe.stamp)
            T, covariance = _resized(fit.T_world_camera, unit), scaled_covariance(fit.covariance, unit)
            yield RelocalizedPose(T, covariance, fit.inliers, by)

    def believed(self, view: StereoKeyframe, known: Sequence[StereoKeyframe], unit: float) -> bool:
        """Returns whether shape and brightness in a view and keyframes of its segment confirm its pose."""
        frame = self._frame(view, unit)
        if frame.depth_flaw is not None:
            return False
        there = [k for k in self._keyframes(known, unit) if k.segment == view.segment]
        T = _resized(view.T_world_camera, 1.0 / unit)
        return believed(frame, T, there, self._camera(view), self._noise(view, unit)) is not None

    def _keyframes(self, known: Sequence[StereoKeyframe], unit: float) -> list[Keyframe]:
        """Returns keyframes with dense depth, made anew only where they are other ones than before."""
        made = {}
        for k in known:
            before = self._made.get(k.stamp)
            same = before is not None and before[0] is k and before[1] == unit
            made[k.stamp] = before if before is not None and same else (k, unit, self._keyframe(k, unit))
        self._made = made
        return [keyframe for _, _, keyframe in made.values()]

    def _keyframe(self, kept: StereoKeyframe, unit: float) -> Keyframe:
        none = np.zeros((0, 3))
        return Keyframe(
            kept.stamp, _resized(kept.T_world_camera, 1.0 / unit), kept.covariance, kept.left,
            self._surface(kept, unit), none[:, :2], none, np.zeros(0, np.int64), kept.segment,
        )  # fmt: skip

    def _frame(self, view: StereoKeyframe, unit: float) -> Frame:
        surface = self._surface(view, unit)
        flaw = Flaw.EMPTY if surface.coverage < COVERAGE else None
        return Frame(view.stamp, view.left, self._K(view), surface.depth, surface, None, flaw, Watch())

    def _surface(self, kept: StereoKeyframe, unit: float) -> Surface:
        """Matches the pair and returns its depth in units."""
        reach = self._reach(kept)
        count = int(np.ceil(reach / (NEAREST * TYPICAL * unit) / 16)) * 16
        matcher = StereoMatcher(MatchingConfig(disparities=min(max(count, 16), 128)))
        disparity = matcher.match(kept.left, kept.right).disparity + kept.offset / kept.factor
        seen = disparity > SUREST * SIGMA  # false where there is none
        depth = np.where(seen, reach / unit / np.where(seen, disparity, 1.0), 0.0).astype(np.float32)
        return Surface.from_depth(depth, self._K(kept), 1e-3, 1e6, max(1, depth.shape[1] // (WIDTH // 2)))

    def _fitter(self, view: StereoKeyframe, unit: float) -> Fitter:
        return Fitter(self._camera(view), RgbdOdometryConfig(depth_noise=self._noise(view, unit)), Noise())

    def _noise(self, view: StereoKeyframe, unit: float) -> DepthNoise:
        return DepthNoise(quadratic=SIGMA * unit / self._reach(view))

    def _camera(self, view: StereoKeyframe) -> RgbdCamera:
        return RgbdCamera(self._K(view), self._K(view))

    def _K(self, kept: StereoKeyframe) -> Matrix:
        return scaled_intrinsics(self.rig.K, 1.0 / kept.factor)

    def _reach(self, kept: StereoKeyframe) -> float:
        """Returns focal length times baseline, reduced pixels times metres."""
        return float(self.rig.K[0, 0]) / kept.factor * self.rig.baseline


def _resized(T: NDArray[np.float64], factor: float) -> Matrix:
    """Returns a pose in another unit of length."""
    out = T.copy()
    out[:3, 3] *= factor
    return out
