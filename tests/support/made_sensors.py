"""A robot on a made motion with the messages of all its sensors, and the fusion of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from made_motion import Motion
from scipy.spatial.transform import Rotation

from dataflow.messages import Imu, Message, NavSatFix, Odometry, Pose, RadarScan, Transforms
from dataflow.testing import Played, play
from operators.fusion import EkfFusion
from operators.simulator.sensors.gnss import geodetic

RATE = 50
ORIGIN = (48.1, 11.5, 500.0)
MOTION = Motion()
T_BASE_IMU = np.eye(4)
T_BASE_IMU[:3, :3] = Rotation.from_euler("xyz", [0.1, -0.2, 0.7]).as_matrix()
T_BASE_IMU[:3, 3] = [0.2, -0.1, 0.3]
ANTENNA = np.array([-0.3, 0.2, 1.0])
Array = np.ndarray


def extrinsics() -> Transforms:
    T_gnss = np.eye(4)
    T_gnss[:3, 3] = ANTENNA
    T_radar = np.eye(4)
    T_radar[:3, :3] = Rotation.from_euler("z", 0.4).as_matrix()
    T_radar[:3, 3] = [0.4, 0, 0.2]
    parts = [
        Transforms.from_matrix(T, stamp=0, frame="base_link", child_frame=child)
        for child, T in (("imu", T_BASE_IMU), ("gnss", T_gnss), ("radar", T_radar))
    ]
    return Transforms(
        stamp=0,
        frames=("base_link",) * 3,
        child_frames=tuple(p.child_frames[0] for p in parts),
        translations=np.vstack([p.translations for p in parts]),
        rotations=np.vstack([p.rotations for p in parts]),
    )


class Robot:
    """Messages of a robot whose IMU moves by MOTION; every sensor measures what it should, with little noise."""

    def __init__(self, seconds: float = 6.0) -> None:
        rng = np.random.default_rng(2)
        self.t = np.arange(int(seconds * RATE)) / RATE
        self.stamps = np.round(self.t * 1e9).astype(np.int64) + 10**9
        gyro, accel = MOTION.readings(self.t)
        gyro += rng.normal(0, 1e-3, gyro.shape)
        accel += rng.normal(0, 1e-2, accel.shape)
        R = MOTION.rotation(self.t)
        self.T_world_base = []
        for p, r in zip(MOTION.position(self.t), R.as_matrix(), strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = r, p
            self.T_world_base.append(T @ np.linalg.inv(T_BASE_IMU))
        self.imu: list[Message] = [
            Imu(
                stamp=int(s),
                frame="imu",
                angular_velocity=w,
                linear_acceleration=f,
                angular_velocity_covariance=np.eye(3) * 1e-6,
                linear_acceleration_covariance=np.eye(3) * 1e-4,
            )
            for s, w, f in zip(self.stamps, gyro, accel, strict=True)
        ]
        self.rate = gyro
        self.velocity = R.inv().apply(MOTION.velocity(self.t))

    def fixes(self, *, altitude: bool = True) -> list[NavSatFix]:
        made: list[NavSatFix] = []
        for k in range(0, len(self.t), 5):
            T = self.T_world_base[k]
            place = T[:3, :3] @ ANTENNA + T[:3, 3]
            lat, lon, alt = geodetic(place, *ORIGIN)
            made.append(
                NavSatFix(
                    stamp=int(self.stamps[k]),
                    frame="gnss",
                    latitude=lat,
                    longitude=lon,
                    altitude=alt if altitude else float("nan"),
                    covariance=np.eye(3) * 0.02**2,
                )
            )
        return made

    def poses(self, cls: type = Pose, frame: str = "world", **more: Any) -> list[Any]:
        name = {Pose: "covariance", Odometry: "pose_covariance"}[cls]
        return [
            cls.from_matrix(
                self.T_world_base[k],
                stamp=int(self.stamps[k]),
                frame=frame,
                child_frame="base_link",
                **{name: np.eye(6) * 0.01**2},
                **more,
            )
            for k in range(0, len(self.t), 5)
        ]

    def scans(self) -> list[Message]:
        made: list[Message] = []
        azimuths = np.linspace(-1, 1, 6)
        T_radar = extrinsics().matrix("radar")
        T_imu_radar = np.linalg.inv(T_BASE_IMU) @ T_radar
        for k in range(0, len(self.t), 5):
            own = self.velocity[k] + np.cross(self.rate[k], T_imu_radar[:3, 3])
            directions = np.column_stack([np.cos(azimuths), np.sin(azimuths), 0 * azimuths])
            speeds = -(directions @ (T_imu_radar[:3, :3].T @ own))
            speeds[2] += 1.0  # something that moves
            made.append(
                RadarScan(
                    stamp=int(self.stamps[k]),
                    frame="radar",
                    ranges=np.full(6, 5.0),
                    azimuths=azimuths,
                    velocities=speeds,
                )
            )
        return made


def fused(
    streams: dict[str, list[Any]], *, lists: dict[str, Any] | None = None, **params: Any
) -> tuple[EkfFusion, Played]:
    params["sensors"] = {name: {} for name in streams} | params.get("sensors", {})
    operator = EkfFusion(**({"heading": 0.7, "origin": ORIGIN} | params))
    given: dict[str, Any] = {"measurements": streams, "extrinsics": [extrinsics()], **(lists or {})}
    return operator, play(operator, given, static=["extrinsics", *(lists or {})])


def errors(robot: Robot, played: Played) -> tuple[Array, Array]:
    """Of position (N,) and orientation (N,), m and rad, at the odometry's stamps as long as the motion is known."""
    known = [m for m in played["odometry"] if m.stamp <= robot.stamps[-1]]
    rows = np.searchsorted(robot.stamps, [m.stamp for m in known])
    made = np.array([m.matrix() for m in known])
    true = np.array(robot.T_world_base)[rows]
    turned = Rotation.from_matrix(made[:, :3, :3]) * Rotation.from_matrix(true[:, :3, :3]).inv()
    return np.linalg.norm(made[:, :3, 3] - true[:, :3, 3], axis=1), turned.magnitude()
