"""CloudRegistration on scans of a made room, moved by known motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataflow.messages import Message, PointCloud
from dataflow.messages.geometry import invert, transform_points
from dataflow.testing import play
from operators.cloud import CloudRegistration
from operators.cloud.registration import Prepared, Registered, Settings, best_of, explained, failure, refine
from operators.geometry import se3

BOXES = np.array(  # centre and half extents of what stands in a room of 6 x 4 x 2.4 m
    [[2.2, 1.2, 0.5, 0.5, 0.3, 0.5], [-2.3, -1.0, 0.9, 0.3, 0.6, 0.9], [0.4, -1.6, 0.35, 0.8, 0.25, 0.35],
     [-1.2, 1.5, 1.0, 0.25, 0.3, 1.0], [2.7, -1.2, 0.2, 0.2, 0.5, 0.2]]
)  # fmt: skip
ROOM = np.array([3.0, 2.0, 1.2])


def scan(T: np.ndarray, seed: int, boxes: np.ndarray = BOXES, room: np.ndarray = ROOM) -> np.ndarray:
    """What a LiDAR at T (4, 4) in the room sees, (N, 3) in its own frame, with 1 cm of noise."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 240, endpoint=False) + 0.005, np.linspace(-0.5, 0.5, 32)
    )
    own = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    own = own.reshape(-1, 3)
    d = own @ T[:3, :3].T
    p = T[:3, 3] - [0, 0, room[2]]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = ((np.sign(d) * room - p) / d).min(axis=1)
        for box in boxes:
            one, two = ((box[:3] + s * box[3:] - T[:3, 3]) / d for s in (-1, 1))
            near, far = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
            reach = np.where((near < far) & (near > 0) & (near < reach), near, reach)
    reach += np.random.default_rng(seed).normal(0, 0.01, len(reach))
    return own * reach[:, None]


def at(x: float, y: float, yaw: float) -> np.ndarray:
    T = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
    T[:3, 3] = x, y, 0.9
    return T


def cloud(points: np.ndarray, stamp: int = 1, frame: str = "lidar") -> PointCloud:
    return PointCloud(stamp=stamp, frame=frame, points=points.astype(np.float32))


def registered(source: np.ndarray, target: np.ndarray, **params: object) -> dict[str, list[Message]]:
    streams = {"cloud": [cloud(source)], "target": [cloud(target, frame="map")]}
    return play(CloudRegistration(**{"trials": 20_000} | params), streams).outputs


def reason(outputs: dict[str, list[Message]]) -> str:
    (status,) = outputs["status"]
    return status.messages[0]


@pytest.mark.long
@pytest.mark.parametrize("there", [(0.8, 0.4, 2.0), (-1.0, -0.3, -1.0)])
def test_two_scans_of_a_room_are_registered_without_a_guess(there: tuple[float, float, float]) -> None:
    A, B = at(0.2, 0.1, 0.0), at(*there)
    source = scan(B, 2)
    outputs = registered(source, scan(A, 1))
    assert reason(outputs) == "registered"
    (pose,), (aligned,) = outputs["pose"], outputs["aligned"]
    truth = invert(A) @ B
    off = se3.log(invert(truth) @ pose.matrix())
    assert np.linalg.norm(off[:3]) < 0.02
    assert np.linalg.norm(off[3:]) < 0.01
    assert (pose.frame, pose.child_frame, aligned.frame) == ("map", "lidar", "map")
    np.testing.assert_allclose(aligned.points, transform_points(pose.matrix(), source), atol=1e-5)
    assert np.linalg.eigvalsh(pose.covariance).min() > 0
    assert off[:3] @ np.linalg.solve(pose.covariance[:3, :3], off[:3]) < 30


def explained_at_the_truth(one: np.ndarray, other: np.ndarray, A: np.ndarray, B: np.ndarray) -> Registered:
    source, target = (Prepared.of_cloud(points.astype(np.float32), 0.1) for points in (other, one))
    return refine(source, target, invert(A) @ B, Settings(0.1, 1, 0.5, 0.85, 0.04))


def test_thin_things_and_a_walking_person_are_no_contradiction() -> None:
    """Beams pass beside poles, so the same poles are seen before and behind them from two places."""
    poles = np.array([[x, y, 1.2, 0.02, 0.02, 1.2] for x in (-1.8, 1.8) for y in (-1.5, -0.5, 0.5, 1.5)])
    A, B = at(0.2, 0.1, 0.0), at(0.9, -0.2, 0.6)
    walks = [np.vstack([BOXES, poles, [[x, 1.0, 0.85, 0.2, 0.2, 0.85]]]) for x in (-0.9, 1.3)]
    found = explained_at_the_truth(scan(A, 1, walks[0]), scan(B, 2, walks[1]), A, B)
    assert found.reason == ""
    wrong = invert(A) @ B @ se3.exp(np.array([0, 0, 0, 0, 0, np.pi]))
    assert refine(
        *(Prepared.of_cloud(scan(T, 1, walks[0]).astype(np.float32), 0.1) for T in (B, A)),
        wrong, Settings(0.1, 1, 0.5, 0.85, 0.04),
    ).reason  # fmt: skip


def test_long_room_is_registered_along_its_length() -> None:
    """Its walls are near to its long axis, which is no reason to doubt how it is turned about that."""
    long = np.array([9.0, 0.9, 1.2])
    niches = np.array([[x, y, 1.0, 0.3, 0.2, 1.0] for x, y in ((-6, 0.8), (-3, -0.8), (1, 0.8), (4, -0.8), (7, 0.8))])
    A, B = at(0.0, 0.0, 0.0), at(0.8, 0.1, 0.1)
    assert explained_at_the_truth(scan(A, 1, niches, long), scan(B, 2, niches, long), A, B).reason == ""


def test_agreeing_surfaces_compensate_low_fitness() -> None:
    A, B = at(0.2, 0.1, 0.0), at(0.9, -0.2, 0.6)
    source, target = (Prepared.of_cloud(scan(T, k, BOXES).astype(np.float32), 0.1) for k, T in enumerate((B, A)))
    T = invert(A) @ B
    easy = Settings(0.1, 1, 0.5, 0.5, 0.1)
    found = explained(source, target, T, easy)
    assert found.reason == ""
    strict = replace(easy, min_fitness=found.fitness + 0.01)
    assert "of what both saw agree" in explained(source, target, T, strict).reason
    assert (
        "of what both saw agree" in explained(source, target, T, replace(strict, sure_score=found.score + 0.01)).reason
    )
    assert explained(source, target, T, replace(strict, sure_score=found.score - 0.01)).reason == ""
    assert "surfaces that agree" in explained(source, target, T, replace(easy, min_score=found.score + 0.01)).reason


def tried(x: float, agreement: float, violation: float = 0.0, overlap: float = 0.8, settled: bool = True) -> Registered:
    """A motion by x metres, with what speaks for it."""
    T = se3.exp(np.array([x, 0, 0, 0, 0, 0]))
    return replace(
        failure(""), T=T, agreement=agreement, violation=violation, overlap=overlap, settled=settled, fitness=0.9
    )


@pytest.mark.parametrize(
    ("other", "ambiguous"),
    [
        (tried(3.0, 0.79), True),
        (tried(0.1, 0.79), False),  # the same motion
        (tried(3.0, 0.70), False),  # explains less
        (tried(3.0, 0.83, violation=0.03), False),  # hangs in free space
        (tried(3.0, 0.83, overlap=0.5), False),  # explains less of the clouds
        (tried(3.0, 0.79, overlap=0.6, settled=False), False),  # slides, and shares less
        (tried(3.0, 0.79, settled=False), True),
    ],
)
def test_a_motion_is_believed_where_no_other_one_explains_as_much(other: Registered, ambiguous: bool) -> None:
    best = tried(0.0, 0.8)
    found = best_of([replace(other, reason="stands no check"), best], 0.1)
    np.testing.assert_array_equal(found.T, best.T)
    assert found.reason.startswith("ambiguous" if ambiguous else "") is True
    assert bool(found.reason) is ambiguous


def test_coarse_floor_voxels_do_not_violate_free_space() -> None:
    """Coarse voxels of a wide floor, seen at a low angle, lie before what is seen in directions beside theirs."""
    boxes = np.array([[x, y, 0.6, 0.4, 0.4, 0.6] for x in (-6, -2, 3, 7) for y in (-3, 3.5)])
    A, B = at(0.2, 0.1, 0.0), at(2.5, 0.1, 0.3)
    one, other = (
        Prepared.of_cloud(scan(T, k, boxes, np.array([15.0, 15.0, 1.2])).astype(np.float32), 0.5)
        for k, T in ((1, A), (2, B))
    )
    assert explained(other, one, invert(A) @ B, Settings(0.5, 1, 0.5, 0.85, 0.04)).violation == 0


@pytest.mark.long
def test_scans_of_different_rooms_fail() -> None:
    other = np.array([[1.0, -1.4, 0.4, 0.3, 0.3, 0.4], [-1.5, 0.5, 0.6, 0.4, 0.2, 0.6]])
    outputs = registered(scan(at(0, 0, 1.0), 2, other, np.array([2.0, 2.6, 1.2])), scan(at(0.2, 0.1, 0), 1))
    assert reason(outputs).startswith("failed: ")
    assert outputs["pose"] == []
    assert outputs["aligned"] == []


@pytest.mark.long
def test_an_empty_symmetric_room_is_not_believed() -> None:
    nothing = np.zeros((0, 6))
    square = np.array([2.0, 2.0, 1.2])
    outputs = registered(scan(at(0.4, 0, 1.0), 2, nothing, square), scan(at(0, 0, 0), 1, nothing, square))
    assert reason(outputs).startswith("failed: ")


@pytest.mark.long
def test_a_bare_passage_is_not_believed() -> None:
    nothing = np.zeros((0, 6))
    passage = np.array([200.0, 1.0, 1.2])
    near = [s[np.linalg.norm(s, axis=1) < 8] for s in (scan(at(x, 0, 0), 1, nothing, passage) for x in (0.0, 1.0))]
    assert reason(registered(near[1], near[0])).startswith("failed: ")


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((500, 3), np.nan), np.ones((50, 3))])
def test_empty_or_featureless_cloud_fails(points: np.ndarray) -> None:
    outputs = registered(points, scan(at(0, 0, 0), 1))
    assert reason(outputs) == "failed: fewer than 100 voxels with a normal"


@pytest.mark.long
def test_runs_repeat() -> None:
    source, target = scan(at(0.8, 0.4, 2.0), 2), scan(at(0.2, 0.1, 0.0), 1)
    one, two = (registered(source, target, trials=5000) for _ in range(2))
    assert [m.digest() for m in one["status"] + one["pose"]] == [m.digest() for m in two["status"] + two["pose"]]
