"""Settings of RGB-D odometry."""

from dataclasses import dataclass, field

from operators.odometry.rgbd.surface import DepthNoise


@dataclass(frozen=True)
class RgbdOdometryConfig:
    """Settings; the defaults suit a hand-held or robot-borne depth camera at 10 to 60 Hz."""

    near: float = 0.3  # metres: smaller depths are no return
    far: float = 6.0  # metres: larger depths are no return
    depth_noise: DepthNoise = field(default_factory=DepthNoise)
    image_width: int = 320  # features work on the image reduced by whole factors to no less than this
    surface_width: int = 160  # and surfaces on the depth image likewise
    corners: int = 300
    min_inliers: int = 15
    refine: bool = True  # False: features only
    references: int = 2  # keyframes whose surfaces a frame is aligned with
    keyframes: int = 30  # remembered
    keyframe_distance: float = 0.1  # radians of view change that make a new keyframe
    acceleration: float = 5.0  # m/s²
    angular_acceleration: float = 20.0  # rad/s²
    decay_s: float = 0.3  # of the velocity while nothing is measured
    patience_s: float = 0.5  # of prediction until the state is lost
    give_up_s: float = 2.0  # in a new map of unknown place until the state is tracking again

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far:
            raise ValueError(f"RgbdOdometryConfig needs 0 < near < far metres, got near={self.near}, far={self.far}")
        for name in ("image_width", "surface_width", "corners", "references", "keyframes"):
            if getattr(self, name) < 1:
                raise ValueError(f"RgbdOdometryConfig.{name} must be at least 1, got {getattr(self, name)}")
        if self.min_inliers < 6:
            raise ValueError(f"RgbdOdometryConfig.min_inliers must be at least 6, got {self.min_inliers}")
