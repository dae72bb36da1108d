"""Motion between frames: constant velocity disturbed by acceleration, dying out while nothing is measured."""

from dataclasses import dataclass

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix, Vector

UNKNOWN_SPEED = 1.0  # m/s and rad/s: how fast a hand or a small robot may already move when first seen

BRIEF = 0.15  # seconds without a measurement in which a velocity hardly changes


@dataclass(frozen=True, eq=False)
class Motion:
    """The last pose and velocity (6,) in the camera's own axes, m/s and rad/s."""

    stamp: int
    T_world_camera: Matrix
    velocity: Vector
    blind_s: float = 0.0  # time since the pose was last measured
    fresh: bool = True  # the velocity is not measured yet

    def predict(self, stamp: int, decay_s: float) -> Matrix:
        """T_world_camera at a stamp. Blind for seconds, standing still is the better guess."""
        dt = self._seconds(stamp)
        travel = decay_s * (np.exp(-self.blind_s / decay_s) - np.exp(-(self.blind_s + dt) / decay_s))
        return self.T_world_camera @ se3.exp(self.velocity * (dt if self.blind_s == 0 else travel))

    def spread(self, stamp: int, acceleration: float, angular_acceleration: float) -> Matrix:
        """Covariance (6, 6) of that prediction, in the camera's axes."""
        dt = self._seconds(stamp)
        unknown = UNKNOWN_SPEED * dt if self.fresh else 0.0
        # Over a blind stretch the displacement of white acceleration grows with the square of the whole time.
        reach = 0.5 * ((self.blind_s + dt) ** 2 - self.blind_s**2)
        return np.diag(
            [(acceleration * reach + unknown) ** 2] * 3 + [(angular_acceleration * reach + unknown) ** 2] * 3
        )

    def measured(self, stamp: int, T_world_camera: Matrix) -> "Motion":
        """Returns the motion after a measured pose. After more than `BRIEF` s without one, the velocity is 0."""
        if self.blind_s > BRIEF:
            return Motion(stamp, T_world_camera, np.zeros(6))
        if self.blind_s > 0:
            return Motion(stamp, T_world_camera, self.velocity, fresh=self.fresh)
        velocity = se3.log(invert(self.T_world_camera) @ T_world_camera) / self._seconds(stamp)
        return Motion(stamp, T_world_camera, velocity, fresh=False)

    def guessed(self, stamp: int, T_world_camera: Matrix) -> "Motion":
        """After a frame that measured nothing."""
        return Motion(stamp, T_world_camera, self.velocity, self.blind_s + self._seconds(stamp), self.fresh)

    def _seconds(self, stamp: int) -> float:
        return (stamp - self.stamp) * 1e-9
