"""Settings of stereo odometry."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StereoOdometryConfig:
    """Settings; the defaults suit a car or a robot with a rectified pair at 10 Hz and more."""

    corners: int = 350
    min_inliers: int = 15
    window: int = 8  # frames adjusted together
    fixed: int = 1  # of these, the oldest; a second one would hold the scale of an offset that is known better by now
    iterations: int = 4
    sigma: float = 0.3  # of a sighting, pixels
    row_error: float = 1.5  # pixels by which a match may leave its row
    min_disparity: float = 1.0  # pixels: farther points do not constrain translation
    acceleration: float = 5.0  # m/s²
    angular_acceleration: float = 2.0  # rad/s²
    decay_s: float = 1.0  # of the velocity while nothing is measured
    patience_s: float = 0.5  # of prediction until the state is lost
    give_up_s: float = 2.0  # in a new map of unknown place until the state is tracking again
    keyframes: int = 30  # pairs kept
    keyframe_distance: float = 0.15  # radians of view change after which another pair is kept

    def __post_init__(self) -> None:
        if self.min_inliers < 6:
            raise ValueError(f"StereoOdometryConfig.min_inliers must be at least 6, got {self.min_inliers}")
        if not 1 <= self.fixed < self.window:
            raise ValueError(
                f"StereoOdometryConfig needs 1 <= fixed < window, got fixed={self.fixed}, window={self.window}"
            )
