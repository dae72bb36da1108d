"""Fusion of places as an operator: triangulated, combined, cross-checked, bad input named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dataflow.messages import LandmarkSightings, Transforms
from dataflow.operator import Context
from dataflow.testing import Played, play
from operators.fusion import PositionFusion

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
    off = [m.positions - THINGS for m in played["places"] if m.stamp >= since and m.count == 2]
    return float(np.sqrt(np.mean(np.square(off))))


def test_two_cameras_triangulate_and_a_lidar_makes_it_better() -> None:
    eyes = {name: camera(name, 40, np.random.default_rng(i)) for i, name in enumerate(EYES)}
    both, _ = fused(eyes)
    beams = lidar(40, np.random.default_rng(5))
    alone, _ = fused({"lidar": beams})
    played, _ = fused({**eyes, "lidar": beams})
    last = [m for m in played["places"] if m.stamp % 100_000_000]
    off = [m.positions - THINGS for m in last]
    together = float(np.sqrt(np.mean(np.square(off))))
    assert together < 0.8 * min(rmse(both), rmse(alone))
    normalised = [
        (p - q) @ np.linalg.solve(C, p - q)
        for m in last
        for p, q, C in zip(m.positions, THINGS, m.covariances, strict=True)
    ]
    assert np.mean(normalised) == pytest.approx(3.0, abs=0.8)


def test_single_bearing_gives_no_position_and_is_counted() -> None:
    played, operator = fused({"left": camera("left", 5, np.random.default_rng(0))})
    assert [m.count for m in played["places"]] == [0] * 5
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
        texts = dict(zip(status.names, status.messages, strict=True))
        expected = "sensors contradict each other" if status.stamp > 2_000_000_000 else "sensors agree"
        assert texts["fusion"] == expected
    assert texts["sightings/right"] in ("contradicts the others", "covariance too small")
    assert texts["sightings/lidar"] == "used"


def process(operator: PositionFusion, message: LandmarkSightings) -> None:
    operator.process({"ns/lidar/things": message}, Context(message.stamp), {"ns/robot/extrinsics": mounts()})


def test_unusable_sightings_are_counted_by_reason_and_others_used() -> None:
    operator = PositionFusion()
    operator.setup()
    good = lidar(1, np.random.default_rng(0))[0]
    positions, covariances = np.array(good.positions), np.array(good.covariances)
    positions[0, 0] = np.nan
    covariances[1] = 0.0
    process(operator, good.replace(positions=positions))
    process(operator, good.replace(stamp=good.stamp + 1, covariances=covariances))
    process(operator, good.replace(stamp=good.stamp + 2, ids=[-1, 8]))
    assert operator.summary()["ignored, lidar/things: not finite, or covariance not positive"] == 2
    assert operator.summary()["ignored, lidar/things: no identity"] == 1
    with pytest.raises(ValueError, match="lidar/things: sightings have no covariances"):
        process(operator, good.replace(stamp=good.stamp + 3, covariances=None))
    with pytest.raises(ValueError, match="no transform between 'arm' and 'base_link'"):
        process(operator, good.replace(stamp=good.stamp + 4, frame="arm"))


def test_sightings_that_do_not_come_after_the_last_are_counted() -> None:
    operator = PositionFusion()
    operator.setup()
    good = lidar(1, np.random.default_rng(0))[0]
    for stamp in (good.stamp, good.stamp, good.stamp - 1):
        operator.process(
            {"ns/lidar/things": good.replace(stamp=stamp)}, Context(good.stamp), {"ns/robot/extrinsics": mounts()}
        )
    assert operator.summary()["ignored, lidar/things: stamp not later than the last"] == 2


def test_two_plays_give_equal_bits() -> None:
    plays = []
    for _ in range(2):
        eyes = {name: camera(name, 10, np.random.default_rng(i)) for i, name in enumerate(EYES)}
        plays.append(fused({**eyes, "lidar": lidar(10, np.random.default_rng(5))})[0].digests())
    assert plays[0] == plays[1]


def test_extrinsics_may_come_on_one_stream_per_sensor() -> None:
    rng = np.random.default_rng(4)
    whole = mounts()
    apart = {
        f"ns/{name}/extrinsics": Transforms(
            stamp=0,
            frames=("base_link",),
            child_frames=(name,),
            translations=whole.translations[[k]],
            rotations=whole.rotations[[k]],
        )
        for k, name in enumerate(whole.child_frames)
    }
    seen = {f"ns/{name}/things": camera(name, 1, rng)[0] for name in EYES}
    stamp = seen["ns/left/things"].stamp
    found = []
    for extrinsics in (apart, {"ns/robot/extrinsics": whole}):
        operator = PositionFusion()
        operator.setup()
        found.append(operator.process(seen, Context(stamp), extrinsics)["places"])
    assert found[0].count == 2
    np.testing.assert_allclose(found[0].positions, THINGS, atol=0.2)
    assert found[0] == found[1]
