"""Motion of a LiDAR: the measured one, its prediction, and the covariance of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix, Vector


@dataclass(frozen=True, eq=False)
class LidarMotion:
    """The last measured pose `T` (4, 4) in the odometry frame, and the velocity (6,) there, in the sensor's axes.

    `covariance` (6, 6) is of a left perturbation, exp(e) T: one that moves the whole map of a place and the pose in it
    alike. `fresh` where no velocity is known yet. `before_T` (4, 4), at `before_stamp`, is the pose measured before.
    """

    stamp: int
    T: Matrix
    velocity: Vector
    covariance: Matrix
    fresh: bool = True
    before_stamp: int = 0
    before_T: Matrix | None = None

    def seconds(self, stamp: int) -> float:
        """Returns the time since the pose was measured."""
        return (stamp - self.stamp) * 1e-9

    def predicted(self, stamp: int, patience: float) -> Matrix:
        """Returns the pose at a stamp with constant velocity, for at most `patience` seconds; then it stands still."""
        return self.T @ se3.exp(self.velocity * min(self.seconds(stamp), patience))

    def spread(self, stamp: int, acceleration: float, angular_acceleration: float, start_speed: float) -> Matrix:
        """Returns the covariance (6, 6) of that prediction alone, a right perturbation of it."""
        dt = self.seconds(stamp)
        linear = start_speed * dt if self.fresh else acceleration * dt**2
        angular = np.pi / 2 * dt if self.fresh else angular_acceleration * dt**2
        return np.diag([linear**2] * 3 + [min(angular, np.pi) ** 2] * 3)

    def velocity_to(self, T: Matrix, stamp: int) -> Vector:
        """Returns the mean velocity from the last measured pose to another."""
        velocity: Vector = se3.log(invert(self.T) @ T) / self.seconds(stamp)
        return velocity

    def sweep_velocity(self, T: Matrix, stamp: int) -> Vector:
        """Returns the velocity that a scan which ends in a pose is deskewed by: the mean from the last pose but one.

        From the last pose alone, an error of it would come back with the other sign, scan after scan: the middle of the
        sweep stays right, and its two ends swing. Over two scans, a third of the error comes back.
        """
        if self.before_T is None:
            return self.velocity_to(T, stamp)
        velocity: Vector = se3.log(invert(self.before_T) @ T) / ((stamp - self.before_stamp) * 1e-9)
        return velocity


def corrected(T: Matrix, information: Matrix, spread: Matrix, of_map: Matrix, of_last: Matrix) -> tuple[Matrix, Matrix]:
    """Returns the covariance of a pose fitted to a map, as left perturbation, and the share without the map's.

    Along directions that the scan constrains, the error is that of the map (`of_map`), elsewhere that of the last pose
    (`of_last`) and of the motion since (`spread`, a right perturbation). Both errors are taken as one, since they have
    the same past.
    """
    own = np.linalg.inv(information + np.linalg.inv(spread))
    adjoint = se3.adjoint(T)
    measured = adjoint @ own @ information @ np.linalg.inv(adjoint)
    root = measured @ _root(of_map) + (np.eye(6) - measured) @ _root(of_last)
    return root @ root.T + adjoint @ own @ adjoint.T, own


def as_right(covariance: Matrix, T: Matrix) -> Matrix:
    """Returns the covariance of the right perturbation of T from that of the left one."""
    A = se3.adjoint(invert(T))
    turned: Matrix = A @ covariance @ A.T
    return turned


def as_left(covariance: Matrix, T: Matrix) -> Matrix:
    """Returns the covariance of the left perturbation of T from that of the right one."""
    A = se3.adjoint(T)
    turned: Matrix = A @ covariance @ A.T
    return turned


def _root(covariance: Matrix) -> Matrix:
    values, axes = np.linalg.eigh(covariance)
    root: Matrix = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return root
