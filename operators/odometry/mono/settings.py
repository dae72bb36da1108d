"""Settings of monocular odometry."""

from dataclasses import dataclass, field

from operators.odometry.mono.two_view import TwoViewConfig


@dataclass(frozen=True)
class RangingConfig:
    """Settings of a scale that is taken from depth images."""

    near: float = 0.3  # metres: smaller depths are no return
    far: float = 6.0  # metres: larger depths are no return
    surface_width: int = 160  # the depth image is reduced by whole factors to no less than this
    min_points: int = 15  # points of the map with a depth that a scale may rest on
    sigma: float = 0.01  # share by which all depths may be wrong alike

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far:
            raise ValueError(f"RangingConfig needs 0 < near < far metres, got near={self.near}, far={self.far}")


@dataclass(frozen=True)
class MonoOdometryConfig:
    """Settings; the defaults suit a hand-held or robot-borne camera at 10 to 60 Hz."""

    two_view: TwoViewConfig = field(default_factory=TwoViewConfig)
    image_width: int = 480  # the image is reduced by whole factors to no less than this
    corners: int = 400
    min_inliers: int = 20
    sigma: float = 0.7  # pixels of a sighting
    gate: float = 3.0  # sigmas beyond which a sighting disagrees
    window: int = 8  # keyframes adjusted together
    fixed: int = 2  # of these, the oldest, which hold the others and the scale
    iterations: int = 6
    keyframes: int = 30  # remembered
    keyframe_distance: float = 0.08  # radians of view change that make a new keyframe
    min_angle: float = 0.015  # radians between the rays of a new point
    acceleration: float = 3.0  # map units/s²
    angular_acceleration: float = 10.0  # rad/s²
    decay_s: float = 0.3  # of the velocity while nothing is measured
    patience_s: float = 0.5  # of prediction until the state is lost
    give_up_s: float = 3.0  # of being lost until a new map begins
    reference_sigma: float = 0.02  # share by which the reference's ways may be wrong
    ranging: RangingConfig = field(default_factory=RangingConfig)

    def __post_init__(self) -> None:
        if self.min_inliers < 8:
            raise ValueError(f"MonoOdometryConfig.min_inliers must be at least 8, got {self.min_inliers}")
        if not 2 <= self.fixed < self.window <= self.keyframes:
            raise ValueError(
                "MonoOdometryConfig needs 2 <= fixed < window <= keyframes, got "
                f"fixed={self.fixed}, window={self.window}, keyframes={self.keyframes}"
            )
