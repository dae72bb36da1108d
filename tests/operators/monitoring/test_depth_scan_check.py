"""A depth camera and a LiDAR that do not fit are named, with by how much; those that fit are not."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from repeated import assert_repeats

from dataflow import Played, play
from dataflow.messages import DepthImage, Odometry, PointCloud, Transforms
from operators.geometry.se3 import exp
from operators.monitoring import DepthScanCheck
from operators.monitoring.depth_scan import DepthScanAgreement
from tests.operators.monitoring.rooms import T_BASE_DEPTH, T_BASE_LIDAR, K, extrinsics, info, views, warnings


@cache
def pairs(scale: float = 1.0) -> tuple[list[PointCloud], list[DepthImage]]:
    seen = list(views(14, scale))
    return [cloud for _, _, cloud in seen], [depth for depth, _, _ in seen]


def checked(known: Transforms, scale: float = 1.0) -> Played:
    clouds, depths = pairs(scale)
    given = {"cloud": clouds, "depth": depths, "depth_info": [info("depth")], "extrinsics": [known]}
    return play(DepthScanCheck(), given, static=["depth_info", "extrinsics"])


def test_sensors_that_fit_raise_no_alarm() -> None:
    played = checked(extrinsics())
    assert len(played["status"]) == 14
    assert warnings(played) == []


@pytest.mark.parametrize(
    ("scale", "text"), [pytest.param(1.05, "5.0% too long", marks=pytest.mark.long), (0.96, "4.0% too short")]
)
def test_depths_of_another_scale_are_reported_with_the_scale(scale: float, text: str) -> None:
    said = warnings(checked(extrinsics(), scale))
    assert len(said) >= 8
    assert text in said[-1]


@pytest.mark.parametrize("sensor", ["depth", "lidar"])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_turned_sensor_is_reported_within_seconds(sensor: str, axis: str) -> None:
    said = warnings(checked(extrinsics(**{sensor: (axis, 3.0)})))
    assert len(said) >= 5
    assert "turned by" in said[-1]


def test_misfit_aligns_scans_with_the_depth() -> None:
    agreement = DepthScanAgreement()
    wrong = exp(np.array([0.0, 0.0, 0.0, 0.02, -0.03, 0.01]))
    for cloud, depth in zip(*pairs(1.03), strict=True):
        T = wrong @ np.linalg.inv(T_BASE_DEPTH) @ T_BASE_LIDAR
        agreement.add(depth.data, K, cloud.points.astype(np.float64), T)
    found = agreement.misfit()
    assert found.scale == pytest.approx(0.03, abs=0.003)
    assert found.turn == pytest.approx([-0.02, 0.03, -0.01], abs=0.006)


def test_scans_with_times_are_deskewed_by_the_velocity_or_left_out() -> None:
    clouds, depths = pairs()
    turn = 0.8
    offsets = np.full(clouds[0].count, 0.1, np.float32)
    back = exp(np.array([0, 0, 0, 0, 0, -turn * 0.1]))[:3, :3]
    late = [c.replace(points=(c.points @ back.T.astype(np.float32)), time_offsets=offsets) for c in clouds]
    moving = [
        Odometry.from_matrix(
            np.eye(4), stamp=c.stamp, frame="odom", child_frame="lidar", linear=[0, 0, 0], angular=[0, 0, turn]
        )
        for c in clouds
    ]
    given = {"cloud": late, "depth": depths, "depth_info": [info("depth")], "extrinsics": [extrinsics()]}
    told = play(DepthScanCheck(), given | {"motion": moving}, static=["depth_info", "extrinsics"])
    assert warnings(told) == []
    assert told["status"][-1].pairs(0)["pairs"] == "14"
    untold = play(DepthScanCheck(), given, static=["depth_info", "extrinsics"])
    assert untold["status"][-1].pairs(0)["without a velocity"] == "14"


def test_restored_check_continues_identically() -> None:
    calls = [(cloud, depth, info("depth"), extrinsics()) for cloud, depth in zip(*pairs(1.05), strict=True)]
    assert_repeats(DepthScanCheck, calls[:7], 6)
