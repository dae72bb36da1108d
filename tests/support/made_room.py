"""A made room with a robot that drives a loop in it: true map, true poses, and what its sensors would measure."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import Imu, LandmarkSightings, LaserScan, OccupancyGrid, Odometry, Pose, Transforms
from dataflow.messages.geometry import quaternion_from_yaw

Array = np.ndarray
CELL = 0.05
LANDMARKS = np.array([[-3.5, -2.5, 1.0], [3.2, -2.7, 1.0], [-3.4, 2.6, 1.0], [0.4, 2.7, 1.0], [3.3, 0.2, 1.0]])


def room() -> OccupancyGrid:
    """A room of 8 by 6 m without symmetry: a corner is cut off, and three things stand in it."""
    rows, columns = np.mgrid[0:128, 0:168]
    x, y = columns * CELL - 4.2, rows * CELL - 3.2
    inside = (np.abs(x) < 4) & (np.abs(y) < 3) & ~((x > 1.5) & (y > 1.0))
    for cx, cy, w, h in ((-2.9, 2.2, 0.6, 0.5), (-0.4, -2.6, 1.2, 0.4), (3.4, -1.2, 0.4, 0.7)):
        inside &= ~((np.abs(x - cx) < w) & (np.abs(y - cy) < h))
    return OccupancyGrid(
        stamp=0,
        frame="world",
        resolution=CELL,
        cells=np.where(inside, 0, 100).astype(np.int8),
        position=[-4.2, -3.2, 0.0],
    )


def mounts() -> Transforms:
    """The laser scanner, 30 cm above the floor."""
    T = np.eye(4)
    T[2, 3] = 0.3
    return Transforms.from_matrix(T, stamp=0, frame="base_link", child_frame="laser")


class Drive:
    """A loop at 0.5 m/s; `carried` puts the robot elsewhere on it at a time (s), by a share of the loop."""

    def __init__(self, seconds: float = 8.0, seed: int = 0, carried: tuple[float, float] | None = None) -> None:
        self.seed, self.grid = seed, room()
        self.count = int(seconds * 20)
        self.carried = carried

    def pose(self, t: float) -> Array:
        """The true pose (x, y, yaw)."""
        a = 0.5 * t / 1.4
        if self.carried is not None and t >= self.carried[0]:
            a += 2 * math.pi * self.carried[1]
        return np.array(
            [1.9 * math.cos(a) - 0.6, 1.1 * math.sin(a) - 0.6, math.atan2(1.1 * math.cos(a), -1.9 * math.sin(a))]
        )

    def stamps(self, every: int = 1) -> list[int]:
        return [50_000_000 * k for k in range(1, self.count, every)]

    def odometry(self, slip: float = 0.0) -> list[Odometry]:
        """Dead reckoning at 20 Hz that notices no carrying; `slip`: its turns are wrong by this share."""
        rng = np.random.default_rng([self.seed, 0])
        believed, made, before = np.zeros(3), [], self.pose(0.05)
        for stamp in self.stamps():
            now = self.pose(stamp * 1e-9)
            if self.carried is None or not stamp * 1e-9 - 0.05 < self.carried[0] <= stamp * 1e-9:
                c, s = np.cos(before[2]), np.sin(before[2])
                dx, dy = (now - before)[:2]
                turn = (now[2] - before[2] + math.pi) % (2 * math.pi) - math.pi
                step = np.array([c * dx + s * dy, c * dy - s * dx])
                step += rng.normal(0, 0.002, 2)
                C, S = math.cos(believed[2]), math.sin(believed[2])
                believed = believed + np.array(
                    [C * step[0] - S * step[1], S * step[0] + C * step[1], turn * (1 + slip)]
                )
            before = now
            made.append(
                Odometry(
                    stamp=stamp,
                    frame="odom",
                    child_frame="base_link",
                    position=[believed[0], believed[1], 0.0],
                    orientation=quaternion_from_yaw(believed[2]),
                )
            )
        return made

    def gyro(self) -> list[Imu]:
        """Rates at 100 Hz, with noise."""
        rng = np.random.default_rng([self.seed, 1])
        made = []
        for k in range(5, self.count * 5):
            t = k * 0.01
            turn = (self.pose(t)[2] - self.pose(t - 0.01)[2] + math.pi) % (2 * math.pi) - math.pi
            rate = turn / 0.01 if abs(turn) < 0.1 else 0.0
            made.append(
                Imu(
                    stamp=k * 10_000_000,
                    frame="base_link",
                    angular_velocity=[0, 0, rate + rng.normal(0, 0.002)],
                    linear_acceleration=[0, 0, 9.81],
                )
            )
        return made

    def scans(self, *, turned: float = 0.0, after: float = 0.0, longer: float = 0.0) -> list[LaserScan]:
        """72 beams at 10 Hz with 1 cm of noise; after a time they are `turned` (rad) and `longer` (m)."""
        rng = np.random.default_rng([self.seed, 2])
        made = []
        for stamp in self.stamps(2):
            wrong = stamp * 1e-9 >= after
            x, y, yaw = self.pose(stamp * 1e-9)
            angles = np.linspace(-math.pi, math.pi - 2 * math.pi / 72, 72)
            ranges = self._cast(x, y, yaw + angles + (turned if wrong else 0.0)) + rng.normal(0, 0.01, 72)
            made.append(
                LaserScan(
                    stamp=stamp,
                    frame="laser",
                    angle_min=float(angles[0]),
                    angle_max=float(angles[-1]),
                    ranges=(ranges + (longer if wrong else 0.0)).astype(np.float32),
                )
            )
        return made

    def sightings(self, *, known: bool = True, off: float = 0.0, after: float = 0.0) -> list[LandmarkSightings]:
        """All landmarks at 5 Hz; after a time they are seen too far by `off` (m)."""
        rng = np.random.default_rng([self.seed, 3])
        made = []
        for stamp in self.stamps(4):
            x, y, yaw = self.pose(stamp * 1e-9)
            d = LANDMARKS[:, :2] - [x, y]
            noise = rng.standard_normal((2, len(d)))
            made.append(
                LandmarkSightings(
                    stamp=stamp,
                    frame="base_link",
                    ids=np.arange(len(d)) if known else np.full(len(d), -1),
                    ranges=np.linalg.norm(d, axis=1) + 0.03 * noise[0] + (off if stamp * 1e-9 >= after else 0.0),
                    bearings=np.arctan2(d[:, 1], d[:, 0]) - yaw + 0.01 * noise[1],
                    covariances=np.tile(np.diag([0.03**2, 0.01**2]), (len(d), 1, 1)),
                )
            )
        return made

    def positions(self, sigma: float = 0.05) -> list[Pose]:
        """Positions in the world at 5 Hz, without heading."""
        rng = np.random.default_rng([self.seed, 4])
        C = np.diag([sigma**2, sigma**2, 1.0, 100.0, 100.0, 100.0])
        made = []
        for stamp in self.stamps(4):
            x, y, _ = self.pose(stamp * 1e-9)
            place = np.array([*(np.array([x, y]) + rng.normal(0, sigma, 2)), 0.0])
            made.append(
                Pose(
                    stamp=stamp,
                    frame="world",
                    child_frame="base_link",
                    position=place,
                    orientation=[0, 0, 0, 1],
                    covariance=C,
                )
            )
        return made

    def landmark_map(self) -> LandmarkSightings:
        return LandmarkSightings(stamp=0, frame="world", ids=np.arange(len(LANDMARKS)), positions=LANDMARKS)

    def _cast(self, x: float, y: float, angles: Array) -> Array:
        steps = np.arange(0.02, 9.0, 0.02)
        px, py = x + np.outer(np.cos(angles), steps), y + np.outer(np.sin(angles), steps)
        column, row = ((px + 4.2) / CELL).astype(int), ((py + 3.2) / CELL).astype(int)
        hit = self.grid.cells[np.clip(row, 0, 127), np.clip(column, 0, 167)] == 100
        return steps[hit.argmax(axis=1)]
