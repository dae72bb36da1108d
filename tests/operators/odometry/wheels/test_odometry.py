"""Wheel odometry on motions whose truth is a formula, and what it says of slipping, jumping and silent wheels."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from operator_runs import assert_resumes_alike, texts

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import JointState, WheelTicks
from dataflow.messages.geometry import yaw_of
from dataflow.testing import Played, play
from operators.odometry import WheelOdometry
from operators.odometry.wheels.differential_drive import DifferentialDrive, DriveNoise

MS = 1_000_000
TRACK, RADIUS, TURN = 0.4, 0.08, 2048
METRE = TURN / (2 * math.pi * RADIUS)  # counts
SIDE = {"track": TRACK, "radius": RADIUS, "ticks_per_turn": TURN}


def ticks(rolled: Any, period: int = 50) -> list[WheelTicks]:
    """Counts of metres (N, 2) that left and right have rolled."""
    counts = np.rint(np.asarray(rolled, float) * METRE).astype(np.int64)
    return [WheelTicks(stamp=k * period * MS, names=("left", "right"), ticks=row) for k, row in enumerate(counts)]


def steady(speed: float, turn: float, seconds: float, period: int = 50) -> np.ndarray:
    """Metres (N, 2) rolled at a constant twist."""
    t = np.arange(0, round(seconds * 1000) + 1, period)[:, None] * 1e-3
    return t * np.array([[speed - turn * TRACK / 2, speed + turn * TRACK / 2]])


def driven(messages: list[Any], **params: Any) -> Played:
    return play(WheelOdometry(**(SIDE | {"max_acceleration": 50.0} | params)), {"wheels": messages})


def last_pose(played: Played) -> tuple[float, float, float]:
    odometry = played["odometry"][-1]
    return float(odometry.position[0]), float(odometry.position[1]), float(yaw_of(odometry.orientation))


def states(played: Played) -> list[str]:
    return [text.partition(":")[0] for text in texts(played)]


@pytest.mark.parametrize("period", [50, 1000])
def test_an_arc_is_exact_however_few_readings_there_are(period: int) -> None:
    speed, turn = 0.6, 0.45
    played = driven(ticks(steady(speed, turn, 4.0, period), period), gap="2s")
    radius = speed / turn
    expected = radius * math.sin(turn * 4), radius * (1 - math.cos(turn * 4)), turn * 4
    assert last_pose(played) == pytest.approx(expected, abs=2e-3)
    odometry = played["odometry"][-1]
    assert odometry.linear.tolist() == pytest.approx([speed, 0, 0], abs=0.01)
    assert odometry.angular.tolist() == pytest.approx([0, 0, turn], abs=0.05)


def test_turning_on_the_spot_and_backing_up_move_nothing_else() -> None:
    assert last_pose(driven(ticks(steady(0, 1.0, 2.0)))) == pytest.approx((0, 0, 2.0), abs=3e-3)
    assert last_pose(driven(ticks(steady(-0.5, 0, 2.0)))) == pytest.approx((-1.0, 0, 0), abs=3e-3)


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.integers(1, 7))
def test_an_arc_in_parts_is_the_arc(left: float, right: float, parts: int) -> None:
    whole, divided = (DifferentialDrive(TRACK, DriveNoise()) for _ in range(2))
    whole.roll(left, right)
    for _ in range(parts):
        divided.roll(left / parts, right / parts)
    np.testing.assert_allclose(divided.pose, whole.pose, atol=1e-12)


@pytest.mark.long
@given(st.lists(st.tuples(st.floats(-0.4, 0.6), st.floats(-0.4, 0.6)), min_size=1, max_size=8))
def test_the_covariance_is_that_of_drives_with_drawn_errors(steps: list[tuple[float, float]]) -> None:
    noise = DriveNoise(slip=0.004, scale=0.005, track=0.004)
    drive = DifferentialDrive(TRACK, noise)
    for left, right in steps:
        drive.roll(left, right)
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(300):
        scale = 1 + rng.normal(0, noise.scale, 2)
        other = DifferentialDrive(TRACK * (1 + rng.normal(0, noise.track)), noise)
        for step in steps:
            other.roll(*(np.array(step) * scale + rng.normal(0, noise.slip, 2) * np.sqrt(np.abs(step))))
        ends.append(other.pose)
    drawn = np.cov(np.array(ends).T)
    own = drive.covariance()
    floor = 1e-7
    assert np.diag(own) + floor == pytest.approx(np.diag(drawn) + floor, rel=0.5)


def test_the_covariance_is_that_of_many_drives_along_three_arcs() -> None:
    """Drawn at once: fresh slip at every arc, and radii and a track that stay wrong."""
    noise, count, arcs = DriveNoise(slip=0.004, scale=0.005, track=0.004), 40_000, [(0.4, 0.6), (0.5, 0.2), (0.3, -0.1)]
    rng, drive = np.random.default_rng(0), DifferentialDrive(TRACK, noise)
    scale, track = 1 + rng.normal(0, noise.scale, (count, 2)), TRACK * (1 + rng.normal(0, noise.track, count))
    pose = np.zeros((3, count))
    for arc in arcs:
        drive.roll(*arc, doubt=0.002)
        slip = rng.normal(0, noise.slip, (count, 2)) * np.sqrt(np.abs(arc)) + rng.normal(0, 0.002, (count, 2))
        left, right = (np.array(arc) * scale + slip).T
        turn, radius = (right - left) / track, track * (left + right) / (2 * (right - left))
        yaw = pose[2]
        east, north = np.sin(yaw + turn) - np.sin(yaw), np.cos(yaw) - np.cos(yaw + turn)
        pose = pose + np.array([radius * east, radius * north, turn])
    spread = np.sqrt(np.diag(np.cov(pose)))
    np.testing.assert_allclose(drive.pose, pose.mean(axis=1), atol=5e-4)
    np.testing.assert_allclose(drive.covariance() / np.outer(spread, spread), np.corrcoef(pose), atol=0.03)


def test_the_covariance_of_the_velocity_is_that_of_drawn_steps() -> None:
    """Two counts are rounded at each end of a step, and wheels, radii and track err."""
    noise, count, rolled, seconds = DriveNoise(0.004, 0.02, 0.03), 40_000, np.array([0.02, 0.05]), 0.1
    drive, rng = DifferentialDrive(TRACK, noise), np.random.default_rng(1)
    drive.step = 0.003
    read = rolled * (1 + rng.normal(0, noise.scale, (count, 2))) + rng.normal(0, 0.004, (count, 2)) * np.sqrt(rolled)
    read += drive.step * (rng.uniform(-0.5, 0.5, (count, 2)) + rng.uniform(-0.5, 0.5, (count, 2)))
    read += rng.normal(0, 0.001, (count, 2))
    track = TRACK * (1 + rng.normal(0, noise.track, count))
    drawn = np.cov([read.mean(axis=1) / seconds, (read[:, 1] - read[:, 0]) / track / seconds])
    spread = np.sqrt(np.diag(drawn))
    own = drive.twist_covariance(0.02, 0.05, seconds, doubt=0.001)
    np.testing.assert_allclose(own / np.outer(spread, spread), drawn / np.outer(spread, spread), atol=0.03)


def test_uncertainty_grows_with_the_way_and_not_while_standing() -> None:
    path = np.vstack([steady(0.5, 0.1, 5.0), np.repeat(steady(0.5, 0.1, 5.0)[-1:], 40, axis=0)])
    played = driven(ticks(path))
    spread = [np.trace(o.pose_covariance[:2, :2]) for o in played["odometry"]]
    assert all(a < b for a, b in pairwise(spread[:101]))
    assert spread[101] == pytest.approx(spread[-1])
    assert states(played)[-39:] == ["standing"] * 39
    assert np.linalg.eigvalsh(played["odometry"][-1].pose_covariance).min() > 0


def test_wheels_that_speed_up_faster_than_the_robot_slip_and_are_doubted() -> None:
    path = steady(0.5, 0, 2.0)
    path[20:] += [0.0, 0.1]  # the right wheel spins: 10 cm within 50 ms
    calm, spun = driven(ticks(steady(0.5, 0, 2.0))), driven(ticks(path), max_acceleration=3.0, max_speed=10.0)
    assert states(spun)[20:22] == ["slipping", "slipping"]  # it stops spinning as suddenly
    assert states(spun).count("slipping") == 2  # the first speed is no change of speed
    widths = [p["odometry"][-1].pose_covariance[5, 5] ** 0.5 for p in (calm, spun)]
    error = abs(last_pose(spun)[2])
    assert error == pytest.approx(0.25, abs=0.01)
    assert widths[1] > 0.5 * error > 3 * widths[0]


def test_encoder_count_reset_keeps_the_motion() -> None:
    path = steady(0.5, 0, 4.0)
    path[40:] -= path[40] - 50.0
    played = driven(ticks(path))
    assert states(played)[40] == "jumped"
    assert last_pose(played) == pytest.approx((2.0, 0, 0), abs=0.01)
    sure, doubted = (played["odometry"][k].pose_covariance[0, 0] for k in (39, 40))
    assert doubted > sure + 0.02**2


def test_after_a_gap_the_end_is_known_less() -> None:
    messages = ticks(steady(0.5, 0.3, 6.0))
    played = driven(messages[:20] + messages[80:])
    assert states(played)[20] == "after a gap"
    assert states(played).count("after a gap") == 1
    assert played["odometry"][20].pose_covariance[0, 0] > 0.5**2
    assert last_pose(played) == pytest.approx(last_pose(driven(messages)), abs=1e-2)


@pytest.mark.parametrize("kind", ["positions", "velocities"])
def test_joint_states_and_ticks_give_equal_odometry(kind: str) -> None:
    rolled = steady(0.5, 0.3, 3.0)
    values = rolled / RADIUS if kind == "positions" else np.repeat([[0.5 - 0.06, 0.5 + 0.06]], len(rolled), 0) / RADIUS
    joints = [
        JointState(stamp=k * 50 * MS, names=("mast", "left", "right"), **{kind: np.array([9.0, *row])})
        for k, row in enumerate(values)
    ]
    assert last_pose(driven(joints)) == pytest.approx(last_pose(driven(ticks(rolled))), abs=3e-3)


def test_readings_that_are_not_finite_give_no_pose_and_lose_no_way() -> None:
    rolled = steady(0.5, 0.0, 3.0) / RADIUS
    rolled[0] = rolled[30] = np.nan
    joints = [JointState(stamp=k * 50 * MS, names=("left", "right"), positions=row) for k, row in enumerate(rolled)]
    played = driven(joints)
    assert states(played).count("unreadable") == 2
    assert len(played["odometry"]) == len(joints) - 2
    assert last_pose(played)[0] == pytest.approx(1.5 - 0.025, abs=1e-6)


def test_each_side_is_the_mean_of_its_wheels_and_messages_know_their_own_scale() -> None:
    rolled = steady(0.5, 0.2, 2.0)
    counts = np.rint(rolled * METRE * 2).astype(np.int64)
    messages = [
        WheelTicks(
            stamp=k * 50 * MS,
            names=("fl", "fr", "rl", "rr"),
            ticks=np.array([a + 30, b, a - 30, b]),
            radii=np.full(4, RADIUS),
            ticks_per_radian=np.full(4, 2 * TURN / (2 * math.pi)),
        )
        for k, (a, b) in enumerate(counts)
    ]
    played = driven(messages, left=("fl", "rl"), right=("fr", "rr"), radius=1.0, ticks_per_turn=7)
    assert last_pose(played) == pytest.approx(last_pose(driven(ticks(rolled))), abs=3e-3)


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"left": ("port",)}, "no wheel 'port'; there are left, right"),
        ({"radius": None}, "lacks the wheels' radius: set the parameter radius"),
        ({"ticks_per_turn": None}, "set the parameter ticks_per_turn"),
        ({"left": ("right",)}, "wheel 'right' is on both sides"),
    ],
)
def test_missing_or_unknown_settings_are_named(params: dict[str, Any], text: str) -> None:
    with pytest.raises(OperatorFailure, match=text):
        driven(ticks(steady(0.5, 0, 0.2)), **params)


def test_joints_that_tell_nothing_are_named() -> None:
    with pytest.raises(OperatorFailure, match="neither positions nor velocities"):
        driven([JointState(stamp=0, names=("left", "right"))])


def test_restored_operator_resumes_alike() -> None:
    firings = [(message,) for message in ticks(steady(0.5, 0.4, 3.0))]
    assert_resumes_alike(lambda: WheelOdometry(**SIDE, max_acceleration=50.0), firings, 30)
