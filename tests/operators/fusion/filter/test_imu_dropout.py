"""An inertial sensor that is silent, or off, is bridged by what the other sensors see of the motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_sensors import Robot, errors, fused

from dataflow.messages import Diagnostics, Odometry
from dataflow.messages.diagnostics import Level
from dataflow.testing import Played

BEGIN, END = 5_000_000_000, 7_000_000_000


def played(robot: Robot, imu: list[Any]) -> Played:
    """Absolute poses before the gap, velocities by an odometry all the time."""
    streams = {
        "robot/imu": imu,
        "robot/seen": robot.poses(Odometry, frame="odom"),
        "robot/pose": [p for p in robot.poses() if p.stamp < BEGIN],
    }
    sensors = {"robot/seen": {"use": "velocity", "sigma": 0.03, "angular_sigma": 0.02}, "robot/pose": {"use": "pose"}}
    return fused(streams, sensors=sensors, heading=None)[1]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["dropped", "off"])
def test_poses_go_on_without_the_inertial_sensor_and_the_status_reports_it(kind: str) -> None:
    robot, imu = Robot(8.0), []
    for sample in robot.imu:
        if not BEGIN <= sample.stamp < END:
            imu.append(sample)
        elif kind == "off":
            imu.append(sample.replace(angular_velocity=np.zeros(3), linear_acceleration=np.zeros(3)))
    made = played(robot, imu)
    whole, gapped = errors(robot, played(robot, robot.imu))[0], errors(robot, made)[0]
    within = [m for m in made["odometry"] if BEGIN + 100_000_000 < m.stamp < END]
    assert len(within) >= 18
    assert gapped[-1] < whole[-1] + 0.3
    said = {
        status.stamp: status.levels[status.names.index("inertial sensor")]
        for status in made["status"]
        if isinstance(status, Diagnostics) and "inertial sensor" in status.names
    }
    assert said
    assert all(BEGIN <= stamp < END + 1_000_000_000 and level == Level.WARN for stamp, level in said.items())
