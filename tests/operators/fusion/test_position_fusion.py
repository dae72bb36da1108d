"""Fusion of places and poses as operators: combined, cross-checked, any sensor missing, bad input named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dataflow.messages import Diagnostics, Imu, LandmarkSightings, Pose, Transforms
from dataflow.operator import Context
from dataflow.testing import Played, play
from operators.fusion import PoseFusion, PositionFusion

THINGS = np.array([[4.0, 1.0, 0.5], [6.0, -2.0, 1.0]])
EYES = {"left": np.array([0.0, 0.4, 1.0]), "right": np.array([0.0, -0.4, 1.0])}
Array = np.ndarray


def mounts() -> Transforms:
    names = [*EYES, "lidar"]
    places = np.array([*EYES.values(), [0.0, 0.0, 1.5]])
    return Transforms(
        stamp=0,
        frames=("base_link",) * 3,
        child_frames=tuple(names),
        translations=places,
        rotations=np.tile([0, 0, 0, 1.0], (3, 1)),
    )


def camera(name: str, count: int, rng: np.random.Generator, turned: float = 0.0) -> list[LandmarkSightings]:
    """Bearings and elevations of both things, 2 mrad; from half of the messages on they are turned (rad)."""
    made = []
    for k in range(count):
        way = THINGS - EYES[name]
        bearings = np.arctan2(way[:, 1], way[:, 0]) + rng.normal(0, 0.002, 2) + (turned if k >= count // 2 else 0.0)
        elevations = np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1])) + rng.normal(0, 0.002, 2)
        made.append(
            LandmarkSightings(
                stamp=(k + 1) * 100_000_000,
                frame=name,
                ids=[7, 8],
                bearings=bearings,
                elevations=elevations,
                covariances=np.tile(np.eye(2) * 0.002**2, (2, 1, 1)),
            )
        )
    return made


def lidar(count: int, rng: np.random.Generator) -> list[LandmarkSightings]:
    """Positions of both things, 3 cm, 20 ms after the cameras."""
    return [
        LandmarkSightings(
            stamp=(k + 1) * 100_000_000 + 20_000_000,
            frame="lidar",
            ids=[7, 8],
            positions=THINGS - [0, 0, 1.5] + rng.normal(0, 0.03, (2, 3)),
            covariances=np.tile(np.eye(3) * 0.03**2, (2, 1, 1)),
        )
        for k in range(count)
    ]


def fused(streams: dict[str, Any], **params: Any) -> tuple[Played, PositionFusion]:
    operator = PositionFusion(**params)
    return play(operator, {"sightings": streams, "extrinsics": [mounts()]}, static=("extrinsics",)), operator


def rmse(played: Played, since: int = 0) -> float:
    off = [m.positions - THINGS for m in played["places"] if m.stamp >= since and m.count == 2]  # type: ignore[attr-defined]
    return float(np.sqrt(np.mean(np.square(off))))


def test_two_cameras_triangulate_and_a_lidar_makes_it_better() -> None:
    eyes = {name: camera(name, 40, np.random.default_rng(i)) for i, name in enumerate(EYES)}
    both, _ = fused(eyes)
    beams = lidar(40, np.random.default_rng(5))
    alone, _ = fused({"lidar": beams})
    played, _ = fused({**eyes, "lidar": beams})
    last = [m for m in played["places"] if m.stamp % 100_000_000]
    off = [m.positions - THINGS for m in last]  # type: ignore[attr-defined]
    together = float(np.sqrt(np.mean(np.square(off))))
    assert together < 0.8 * min(rmse(both), rmse(alone))
    normalised = [
        (p - q) @ np.linalg.solve(C, p - q)
        for m in last
        for p, q, C in zip(m.positions, THINGS, m.covariances, strict=True)  # type: ignore[attr-defined]
    ]
    assert np.mean(normalised) == pytest.approx(3.0, abs=0.8)


def test_one_camera_alone_gives_no_place_and_says_why() -> None:
    played, operator = fused({"left": camera("left", 5, np.random.default_rng(0))})
    assert [m.count for m in played["places"]] == [0] * 5  # type: ignore[attr-defined]
    assert operator.summary()["ignored, a single bearing"] == 10


def test_a_camera_that_was_knocked_is_named_and_left_out() -> None:
    eyes = {
        "left": camera("left", 40, np.random.default_rng(0)),
        "right": camera("right", 40, np.random.default_rng(1), turned=0.1),
    }
    beams = [m.replace(stamp=m.stamp - 20_000_000) for m in lidar(40, np.random.default_rng(2))]
    played, _ = fused({**eyes, "lidar": beams})
    assert rmse(played, since=2_200_000_000) < 0.05
    for status in played["status"]:
        assert isinstance(status, Diagnostics)
        texts = dict(zip(status.names, status.messages, strict=True))
        expected = "sensors contradict each other" if status.stamp > 2_000_000_000 else "sensors agree"
        assert texts["fusion"] == expected
    assert texts["sightings/right"] in ("contradicts the others", "worse than it says")
    assert texts["sightings/lidar"] == "used"


def poses(count: int, rng: np.random.Generator, off: float = 0.0, turned: float = 0.0) -> list[Pose]:
    """Poses of a body at rest, 2 cm and 0.02 rad."""
    made = []
    for k in range(count):
        R = Rotation.from_rotvec(rng.normal(0, 0.02, 3) + np.array([0, 0, turned])) * Rotation.from_euler("z", 3.1)
        made.append(
            Pose(
                stamp=(k + 1) * 100_000_000,
                frame="world",
                child_frame="base_link",
                position=np.array([1.0, 2.0, 0.0]) + rng.normal(0, 0.02, 3) + [off, 0, 0],
                orientation=R.as_quat(),
                covariance=np.diag([0.02**2] * 6),
            )
        )
    return made


def orientations(count: int, rng: np.random.Generator) -> list[Imu]:
    return [
        Imu(
            stamp=(k + 1) * 100_000_000,
            frame="base_link",
            angular_velocity=[0, 0, 0],
            linear_acceleration=[0, 0, 9.8],
            orientation=(Rotation.from_rotvec(rng.normal(0, 0.005, 3)) * Rotation.from_euler("z", 3.1)).as_quat(),
            orientation_covariance=np.eye(3) * 0.005**2,
        )
        for k in range(count)
    ]


def body(streams: dict[str, Any]) -> tuple[Played, PoseFusion]:
    operator = PoseFusion()
    return play(operator, {"estimates": streams}), operator


def turned(pose: Any) -> float:
    return float((Rotation.from_quat(pose.orientation) * Rotation.from_euler("z", -3.1)).magnitude())


def test_poses_and_an_orientation_near_half_a_turn_are_averaged_on_the_manifold() -> None:
    rng = [np.random.default_rng(k) for k in range(3)]
    played, _ = body({"camera": poses(50, rng[0]), "lidar": poses(50, rng[1]), "imu": orientations(50, rng[2])})
    assert len(played["pose"]) == 50
    assert np.sqrt(np.mean([turned(p) ** 2 for p in played["pose"]])) < 0.01
    missing, operator = body({"imu": orientations(3, rng[2])})
    assert not missing["pose"]
    assert operator.summary()["ignored, position or orientation unknown"] == 3


def test_two_poses_that_contradict_each_other_are_a_diagnostic_and_the_covariance_holds_both() -> None:
    rng = [np.random.default_rng(k) for k in range(2)]
    played, operator = body({"camera": poses(5, rng[0]), "lidar": poses(5, rng[1], off=0.5)})
    assert operator.summary()["two sensors contradicted each other"] == 5
    for pose, status in zip(played["pose"], played["status"], strict=True):
        assert pose.covariance[0, 0] > 0.08**2  # type: ignore[attr-defined]
        assert status.messages[0] == "sensors contradict each other"  # type: ignore[attr-defined]


def test_a_sensor_noisier_than_it_says_loses_its_say() -> None:
    rng = np.random.default_rng(4)
    noisy = [p.replace(position=p.position + rng.normal(0, 0.05, 3)) for p in poses(200, rng)]
    played, _ = body({"a": poses(200, rng), "b": poses(200, rng), "noisy": noisy})
    last = played["status"][-1]
    assert isinstance(last, Diagnostics)
    noise = {name: float(dict(last.pairs(k))["noise"]) for k, name in enumerate(last.names) if k}
    assert noise["estimates/noisy"] > 2.0
    assert max(noise["estimates/a"], noise["estimates/b"]) < 1.7


def test_bad_input_is_named() -> None:
    operator = PoseFusion()
    operator.setup()
    pose = poses(1, np.random.default_rng(0))[0]
    with pytest.raises(ValueError, match="its poses are in 'odom', the fused one is in 'world'"):
        operator.process({"ns/camera/pose": pose.replace(frame="odom")}, Context(pose.stamp))
    with pytest.raises(ValueError, match="camera/pose: its messages have no covariance"):
        operator.process({"ns/camera/pose": pose.replace(covariance=None)}, Context(pose.stamp))
    operator = PoseFusion()
    operator.setup()
    operator.process({"ns/camera/pose": pose.replace(covariance=np.zeros((6, 6)))}, Context(pose.stamp))
    assert operator.summary()["ignored, camera/pose: covariance not positive"] == 1
    places = PositionFusion()
    places.setup()
    blind = LandmarkSightings(stamp=1, frame="base_link", ids=[1], positions=[[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="sightings have no covariances"):
        places.process({"ns/lidar/things": blind}, Context(1))
