"""Drives of a simulated LiDAR that moves during its sweeps: rendered once, and kept as files for several benchmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry, PointCloud, Transforms
from dataflow.messages.geometry import invert
from operators.geometry import se3

Array = NDArray[np.float64]

SENSOR = {"near": 0.5, "far": 30.0, "rate": 10.0, "rows": 16, "columns": 360, "indoors": True}


@dataclass(frozen=True, eq=False)
class Drive:
    """Scans with what is known of the sensor, and the true pose of each (empty where unknown)."""

    clouds: list[PointCloud]
    truth: list[Array]
    sensor: dict[str, Any] = field(default_factory=lambda: dict(SENSOR))

    def without_times(self) -> Drive:
        return Drive([cloud.replace(time_offsets=None) for cloud in self.clouds], self.truth, self.sensor)

    def at_middle(self) -> Drive:
        """Returns the drive with the truth of half a turn before each stamp, which a scan without times shows."""
        steps = [se3.log(invert(a) @ b) for a, b in pairwise(self.truth)]
        truth = [T @ se3.exp(-0.5 * step) for T, step in zip(self.truth, [steps[0], *steps], strict=True)]
        return Drive(self.clouds, truth, self.sensor)

    def part(self, first: int, count: int) -> Drive:
        """Returns `count` scans from the scan number `first` on."""
        return Drive(self.clouds[first : first + count], self.truth[first : first + count], self.sensor)


def rendered(cache: Path, world: str, seed: int, seconds: int, speed: float, route: str = "round") -> Drive:
    """Returns a drive through a simulated world, people and things moving about; it is made where no file has it."""
    file = cache / f"{world}_{seed}_{route}_{seconds}s_{speed}.npz"
    if not file.is_file():
        _render(file, world, seed, seconds, speed, route)
    with np.load(file) as stored:
        points, offsets, ends = stored["points"], stored["offsets"], np.cumsum(stored["counts"])[:-1]
        stamps, truth = stored["stamps"].tolist(), list(stored["truth"])
    clouds = [
        PointCloud(stamp=stamp, frame="lidar", points=part, time_offsets=times)
        for stamp, part, times in zip(stamps, np.split(points, ends), np.split(offsets, ends), strict=True)
    ]
    return Drive(clouds, truth)


def _render(file: Path, world: str, seed: int, seconds: int, speed: float, route: str) -> None:
    from operators.simulator import SimulatedRobot

    off = {"rate": 0.0}
    truth_of: dict[str, Any] = {"poses": 10.0, "boxes": False, "relations": 0.0, "activities": 0.0}
    robot = SimulatedRobot(
        world=world, seed=seed, duration=f"{seconds}s", speed=speed, route=route, color_camera=off, depth_camera=off,
        lidar={"rate": 10.0, "motion": True, "phase": "100ms"}, truth=truth_of,
    )  # fmt: skip
    robot.setup()
    mount = robot.static_outputs()["extrinsics"]
    assert isinstance(mount, Transforms)
    clouds, truth = [], []
    for messages in robot.stream():
        cloud, base = messages.get("points"), messages.get("true_base")
        if isinstance(cloud, PointCloud) and isinstance(base, Odometry):
            clouds.append(cloud)
            truth.append(base.matrix() @ mount.matrix("lidar"))
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}")
    with partial.open("wb") as handle:
        np.savez(
            handle,
            points=np.concatenate([cloud.points for cloud in clouds]),
            offsets=np.concatenate([cloud.time_offsets for cloud in clouds]),
            counts=np.array([len(cloud.points) for cloud in clouds]),
            stamps=np.array([cloud.stamp for cloud in clouds], np.int64),
            truth=np.array(truth),
        )
    partial.replace(file)
