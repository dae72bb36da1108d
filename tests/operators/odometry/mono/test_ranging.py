"""The scale that depth images give a monocular odometry, on images of a made corner of two walls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_walls import RATE, SIZE, K, aside, depth_from, rendered
from numpy.typing import NDArray
from operator_runs import assert_resumes_alike, texts

from dataflow.messages import CameraInfo, DepthImage, Image, Transforms
from dataflow.messages.geometry import transform_points
from dataflow.testing import Played, play
from operators.evaluation.trajectory import align
from operators.geometry import se3
from operators.geometry.pinhole import unproject
from operators.odometry import MonoVisualOdometry
from operators.odometry.mono.ranging import PERSISTENT, MetricDepth, Ranged, RangingMemory, RangingUse, pose_at, ranged
from operators.odometry.mono.scale import Scale
from operators.odometry.mono.settings import RangingConfig
from operators.odometry.motion import Motion
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.tracking import Status, TrackResult

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

COUNT = 40
PERIOD = 10**9 // RATE
STATIC = ("image_info", "depth_info", "extrinsics")
# A depth camera of its own beside the colour camera, with fewer pixels and a wider view.
SMALL = (160, 120)
K_SMALL = np.array([[110.0, 0.0, 79.5], [0.0, 110.0, 59.5], [0.0, 0.0, 1.0]])
BESIDE = np.array([[1.0, 0, 0, 0.12], [0, 1, 0, 0.02], [0, 0, 1, -0.03], [0, 0, 0, 1]])  # T_camera_depth


def stamp(k: float) -> int:
    return round(PERIOD * (k + 1))


def info(frame: str, size: tuple[int, int], K: Array) -> CameraInfo:
    return CameraInfo(stamp=0, frame=frame, width=size[0], height=size[1], K=K)


def streams(depths: dict[int, Depth]) -> dict[str, list[Any]]:
    """Images, and depth images (H, W) of the camera itself at frames."""
    given: dict[str, list[Any]] = {
        "image": [Image(stamp=stamp(k), frame="camera", data=i) for k, i in enumerate(rendered(COUNT))],
        "image_info": [info("camera", SIZE, K)],
    }
    if depths:
        given["depth_info"] = [info("camera", SIZE, K)]
        given["depth"] = [DepthImage(stamp=stamp(k), frame="camera", data=d) for k, d in depths.items()]
    return given


def run(given: dict[str, list[Any]], operator: MonoVisualOdometry | None = None) -> Played:
    return play(operator or MonoVisualOdometry(), given, static=[name for name in STATIC if name in given])


def measured(k: int, noise: float = 0.01) -> Depth:
    """The depth at a frame, with the noise of a depth camera."""
    true = depth_from(aside(COUNT)[k])
    return (true + noise * np.random.default_rng(k).normal(size=true.shape)).astype(np.float32)


def in_metres(played: Played) -> tuple[Array, Array, list[Any]]:
    """Returns positions (N, 3) of what is said to be in metres, the true ones, and the messages."""
    truth = {stamp(k): T[:3, 3] for k, T in enumerate(aside(COUNT))}
    sent: list[Any] = list(played["odometry"])
    poses = [p for p in sent if p.frame == "odom"]
    return np.array([p.position for p in poses]), np.array([truth[p.stamp] for p in poses]), poses


def scale_of(played: Played, last: int) -> float:
    """Returns the factor that brings the last poses to the truth; 1 where they are in metres."""
    estimate, truth, _ = in_metres(played)
    return float(align(estimate[-last:], truth[-last:], scaled=True)[2])


@pytest.mark.long
def test_a_depth_image_now_and_then_gives_metres() -> None:
    played = run(streams({k: measured(k) for k in range(0, COUNT, 8)}))
    estimate, truth, poses = in_metres(played)
    R, t, _ = align(estimate, truth, scaled=False)
    assert len(poses) >= 16
    assert np.linalg.norm(estimate @ R.T + t - truth, axis=1).max() < 0.02
    assert scale_of(played, len(poses)) == pytest.approx(1.0, abs=0.02)
    sure = [np.sqrt(np.trace(p.pose_covariance[:3, :3])) for p in poses]
    assert max(sure) < 0.3
    assert poses[-1].linear is not None
    assert np.linalg.norm(poses[-1].linear) == pytest.approx(0.03 * RATE, rel=0.3)


@pytest.mark.long
def test_the_position_at_which_metres_are_found_counts_from_where_the_map_began() -> None:
    found = 30
    played = run(streams({found: measured(found)}))
    estimate, _, poses = in_metres(played)
    unscaled = [p for p in played["odometry"] if p.frame == "odom_unscaled"]
    way = aside(COUNT)
    assert poses[0].stamp == stamp(found)
    assert unscaled
    assert np.linalg.norm(estimate[0]) == pytest.approx(float(np.linalg.norm(way[found][:3, 3])), rel=0.02)
    assert "gives the scale" in texts(played)[found]


@pytest.mark.parametrize(
    "between", [pytest.param(0.0, marks=pytest.mark.long), 0.4], ids=["of an image's stamp", "between two images"]
)
def test_a_depth_camera_of_another_place_size_and_rate_gives_the_same_metres(between: float) -> None:
    given = streams({})
    frames = [k + between for k in range(0, COUNT - 1, 6)]
    way = aside(2 * COUNT)
    given["depth_info"] = [info("depth", SMALL, K_SMALL)]
    given["extrinsics"] = [Transforms.from_matrix(BESIDE, stamp=0, frame="camera", child_frame="depth")]
    given["depth"] = []
    for k in frames:
        before, after = way[int(k)], way[int(k) + 1]
        T = before.copy()
        T[:3, 3] += (k - int(k)) * (after[:3, 3] - before[:3, 3])
        data = depth_from(T @ BESIDE, K_SMALL, SMALL)
        given["depth"].append(DepthImage(stamp=stamp(k), frame="depth", data=data))
    assert scale_of(run(given), 20) == pytest.approx(1.0, abs=0.02)


@pytest.mark.long
def test_depth_in_a_few_pixels_of_a_hundred_is_enough() -> None:
    rng = np.random.default_rng(5)
    sparse = {k: np.where(rng.random(SIZE[::-1]) < 0.03, measured(k), 0).astype(np.float32) for k in range(0, COUNT, 4)}
    assert scale_of(run(streams(sparse)), 15) == pytest.approx(1.0, abs=0.02)


USELESS = {
    "no return": (lambda k: np.zeros(SIZE[::-1], np.float32), RangingUse.FLAWED),
    "not a number": (lambda k: np.full(SIZE[::-1], np.nan, np.float32), RangingUse.FLAWED),
    "too far": (lambda k: np.full(SIZE[::-1], 50.0 + k, np.float32), RangingUse.FLAWED),
    "noise": (
        lambda k: np.repeat(np.repeat(np.random.default_rng(k).uniform(0.5, 6, (30, 45)), 8, 0), 8, 1).astype("f4"),
        RangingUse.SCATTERED,
    ),
    "a corner of the view": (lambda k: np.pad(measured(k)[:40, :40], ((0, 200), (0, 320))), RangingUse.FEW),
}


@pytest.mark.long
@pytest.mark.parametrize(("make", "use"), USELESS.values(), ids=USELESS.keys())
def test_depth_that_shows_nothing_is_counted_and_changes_no_pose(make: Any, use: RangingUse) -> None:
    operator = MonoVisualOdometry()
    alone = run(streams({}))
    played = run(streams({k: make(k) for k in range(20, COUNT, 2)}), operator)
    assert [p.digest() for p in played["odometry"]] == [p.digest() for p in alone["odometry"]]
    words = texts(played)
    assert all("scale unknown, depth " in words[k] for k in range(20, COUNT, 2))
    assert operator.summary()[f"depth {use}"] == 10


@pytest.mark.long
def test_a_depth_image_that_comes_again_counts_once() -> None:
    operator, once = MonoVisualOdometry(), measured(20)
    alone, again = run(streams({20: once})), run(streams(dict.fromkeys(range(20, 30), once)), operator)
    assert [p.digest() for p in again["odometry"]] == [p.digest() for p in alone["odometry"]]
    assert operator.summary()[f"depth {RangingUse.FLAWED}"] == 9
    assert "depth repeats the last one" in texts(again)[21]


@pytest.mark.long
def test_depth_that_contradicts_a_known_scale_is_left_out() -> None:
    good = {k: measured(k) for k in range(14, 24)}
    wrong = {k: (1.4 * measured(k)).astype(np.float32) for k in range(24, 24 + PERSISTENT - 1)}
    operator = MonoVisualOdometry()
    kept, both = run(streams(good)), run(streams(good | wrong), operator)
    assert [p.digest() for p in both["odometry"]] == [p.digest() for p in kept["odometry"]]
    assert "contradicts the scale (1.4" in texts(both)[25]
    assert operator.summary()[f"depth {RangingUse.CONTRARY}"] == PERSISTENT - 1


def test_wrong_scale_is_corrected_without_a_jump_and_raises_the_covariance() -> None:
    wrong = {k: (1.5 * measured(k)).astype(np.float32) for k in range(14, 20)}
    played = run(streams(wrong | {k: measured(k) for k in range(20, COUNT)}))
    words, (estimate, _, poses) = texts(played), in_metres(played)
    turned = [k for k, text in enumerate(words) if "gives another scale" in text]
    assert turned == [20 + PERSISTENT - 1]
    steps = np.linalg.norm(np.diff(estimate, axis=0), axis=1)
    assert steps.max() < 2 * 0.045  # of 0.03 m a frame, half again too long at first
    assert scale_of(played, 12) == pytest.approx(1.0, abs=0.03)
    spread = [float(np.sqrt(np.trace(p.pose_covariance[:3, :3]))) for p in poses]
    at = [p.stamp for p in poses].index(stamp(turned[0]))
    assert spread[at] > 0.3 * np.linalg.norm(estimate[at])
    assert spread[at - 1] < 0.2 * np.linalg.norm(estimate[at - 1])


@pytest.mark.long
def test_an_input_without_messages_changes_nothing() -> None:
    silent = streams({}) | {"depth": [], "depth_info": []}
    assert play(MonoVisualOdometry(), silent, static=STATIC[:2]).digests() == run(streams({})).digests()


def test_depth_without_a_calibration_is_refused() -> None:
    given = streams({14: measured(14)})
    operator = MonoVisualOdometry()
    operator.setup()
    with pytest.raises(ValueError, match="not depth_info"):
        operator.process(given["image"][0], given["image_info"][0], depth=given["depth"][0])


def test_restored_operator_resumes_alike() -> None:
    given = streams({k: measured(k) for k in range(0, COUNT, 3)})
    depths = {d.stamp: d for d in given["depth"]}
    info, depth_info = given["image_info"][0], given["depth_info"][0]
    firings = [(image, info, None, None, depths.get(image.stamp), depth_info) for image in given["image"][:32]]
    assert_resumes_alike(MonoVisualOdometry, firings, 22)


# -- one depth image ---------------------------------------------------------------------------------------------------


UNITS = 2.5  # metres by each unit of the map
CONFIG = RangingConfig()
SEEN = np.random.default_rng(1).uniform([60, 60], [300, 180], (40, 2))


def given(factor: float = 1.0, at: int = 1) -> MetricDepth:
    """The depth of the corner of walls from the first pose, or what a camera that errs by a factor has."""
    depth = (factor * depth_from(aside(1)[0])).astype(np.float32)
    depth[at] = 0.0  # each image is another
    return MetricDepth(at, depth, RgbdCamera(K, K))


def mapped(count: int = 40) -> Array:
    """Points (N, 3) of the walls that the camera sees, in units of the map."""
    u, v = np.rint(SEEN[:count]).astype(int).T
    z = depth_from(aside(1)[0])[v, u].astype(float)
    rays = unproject(np.column_stack([u, v]).astype(float), K)
    return np.asarray(rays * z[:, None] / UNITS)


def use(
    image: MetricDepth, points: Array, scale: Scale, memory: RangingMemory | None = None, T: Array | None = None
) -> Ranged:
    return ranged(image, points, np.eye(4) if T is None else T, scale, memory or RangingMemory(), CONFIG)


def test_a_depth_image_gives_an_unknown_scale_by_the_points_that_most_agree_on() -> None:
    points = mapped()
    points[:15] *= np.random.default_rng(2).uniform(1.3, 3.0, (15, 1))
    told = use(given(), points, Scale())
    assert (told.use, told.factor) == (RangingUse.FOUND, pytest.approx(UNITS, rel=0.01))
    assert told.scale.sigma == pytest.approx(CONFIG.sigma, abs=0.01)
    assert told.text == "depth of 25 points gives the scale"
    moved = se3.exp(np.array([0.4, -0.2, 0.3, 0.1, 0.5, 0.2]))
    assert use(given(), transform_points(moved, points), Scale(), T=moved).factor == pytest.approx(told.factor)


@pytest.mark.parametrize(("count", "found"), [(14, False), (15, True)])
def test_a_scale_rests_on_so_many_points_and_no_fewer(count: int, found: bool) -> None:
    told = use(given(), mapped(count), Scale())
    assert (told.use is RangingUse.FOUND) == found
    assert found or told.text == "depth has too few points of the map (14)"
    behind = use(given(), np.concatenate([mapped(14), -mapped(10)]), Scale())
    assert behind.use is RangingUse.FEW


def test_depth_contradicting_the_scale_consistently_replaces_it() -> None:
    scale, memory, told = Scale(0.02), RangingMemory(), []
    for at, factor in enumerate((1.4, 1.4, 0.6, 0.6, 0.6, 0.6, 0.6)):
        told.append(use(given(factor, at), UNITS * mapped(), scale, memory))
        memory = told[-1].memory
    assert [t.use for t in told] == [RangingUse.CONTRARY] * (1 + PERSISTENT) + [RangingUse.ANEW]
    assert {t.factor for t in told[:-1]} == {1.0}
    assert {t.scale for t in told[:-1]} == {scale}
    assert told[-1].factor == pytest.approx(0.6, rel=0.01)
    assert told[-1].scale.past == pytest.approx(-np.log(0.6), rel=0.02)
    assert told[-1].memory.contrary == 0
    between = use(given(1.0, 9), UNITS * mapped(), scale, told[3].memory)
    assert (between.use, between.memory.contrary) == (RangingUse.TAKEN, 0)
    assert between.scale.sigma < scale.sigma


def test_depth_is_of_the_pose_at_its_stamp_if_that_was_measured() -> None:
    before, after = Motion(0, aside(9)[0], np.zeros(6)), aside(9)[8]
    result = TrackResult(80, after, np.eye(6), np.zeros(6), Status.TRACKING, "", 9, 0.0, False)
    np.testing.assert_array_equal(pose_at(80, result, None), after)
    way = pose_at(20, result, before)
    np.testing.assert_allclose(way[:3, 3], after[:3, 3] / 4, atol=2e-3)
    for stamp, last in ((90, before), (0, before), (20, None), (20, replace(before, blind_s=0.1))):
        assert pose_at(stamp, result, last) is None
    assert pose_at(80, replace(result, status=Status.PREDICTED), before) is None
