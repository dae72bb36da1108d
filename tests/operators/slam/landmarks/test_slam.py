"""Landmark SLAM: consistent, closes loops, tells landmarks apart, and says what it ignores."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from operator_runs import assert_resumes_alike

from dataflow.messages import LandmarkSightings, Odometry, Transforms
from dataflow.messages.geometry import invert, quaternion_from_yaw, transform_matrix, yaw_of
from dataflow.testing import play
from operators.slam import LandmarkSlam
from operators.slam.landmarks.association import Association
from operators.slam.landmarks.consistency import Consistency
from operators.slam.landmarks.filter import LandmarkFilter
from operators.slam.landmarks.slam import _arc

Array = np.ndarray
PERIOD = 100_000_000
MOTION = np.diag([0.02**2, 0.01**2, 0.01**2])
SIGHT = np.diag([0.05**2, 0.05**2])


def rotation(angle: float) -> Array:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


class Walk:
    """A robot on rounds of 60 steps among landmarks, with the noise that it is told: what it measures and the truth."""

    def __init__(self, seed: int, rounds: int = 2) -> None:
        rng = np.random.default_rng(seed)
        self.landmarks = rng.uniform(-6, 6, (20, 2)) + np.array([0, 4])
        self.poses = [np.zeros(3)]
        self.motions: list[Array] = []
        self.seen: list[tuple[list[int], Array]] = [self._look(self.poses[0], rng)]
        for _ in range(60 * rounds):
            step = np.array([0.4, 0.0, 2 * math.pi / 60])
            x, y, heading = self.poses[-1]
            at = np.array([x, y]) + rotation(heading) @ step[:2]
            self.poses.append(np.array([*at, heading + step[2]]))
            noise = rng.multivariate_normal(np.zeros(3), MOTION)
            self.motions.append(step + noise)
            self.seen.append(self._look(self.poses[-1], rng))

    def _look(self, pose: Array, rng: np.random.Generator) -> tuple[list[int], Array]:
        there = (self.landmarks - pose[:2]) @ rotation(pose[2])
        near = np.flatnonzero(np.linalg.norm(there, axis=1) < 5)
        return near.tolist(), there[near] + rng.multivariate_normal(np.zeros(2), SIGHT, len(near))

    def filtered(self, *, known: bool = True) -> LandmarkFilter:
        made = LandmarkFilter()
        for k, (ids, points) in enumerate(self.seen):
            if k:
                made.move(self.motions[k - 1][:2], float(self.motions[k - 1][2]), MOTION)
            made.see(ids if known else [-1] * len(ids), points, np.tile(SIGHT, (len(ids), 1, 1)))
        return made

    def messages(self, *, known: bool = True) -> dict[str, list[tuple[int, object]]]:
        spread = np.zeros((6, 6))
        spread[np.ix_([0, 1, 5], [0, 1, 5])] = MOTION / (PERIOD * 1e-9) ** 2
        position, heading = np.zeros(2), 0.0
        odometry, sightings = [], []
        for k, (ids, points) in enumerate(self.seen):
            if k:
                position = position + rotation(heading) @ self.motions[k - 1][:2]
                heading += float(self.motions[k - 1][2])
            stamp = (k + 1) * PERIOD
            odometry.append(
                Odometry(
                    stamp=stamp,
                    frame="odom",
                    child_frame="base",
                    position=np.array([*position, 0.0]),
                    orientation=quaternion_from_yaw(heading),
                    twist_covariance=spread,
                )
            )
            sightings.append(
                LandmarkSightings(
                    stamp=stamp,
                    frame="base",
                    ids=np.array(ids if known else [-1] * len(ids), np.int64),
                    positions=points.reshape(-1, 2),
                    covariances=np.tile(SIGHT, (len(ids), 1, 1)),
                )
            )
        return {"odometry": odometry, "sightings": sightings}


def errors(walk: Walk, made: LandmarkFilter) -> Array:
    truth = walk.poses[-1]
    turn = (made.heading - truth[2] + math.pi) % (2 * math.pi) - math.pi
    return np.array([*(made.position - truth[:2]), turn])


@pytest.mark.long
def test_pose_and_map_are_near_the_truth_and_their_covariances_are_honest() -> None:
    nees, off, distances = [], [], []
    for seed in range(30):
        walk = Walk(seed)
        made = walk.filtered()
        e = errors(walk, made)
        nees.append(e @ np.linalg.solve(made.pose_covariance(), e))
        away = made.landmarks - walk.landmarks[made.ids]
        off += list(np.linalg.norm(away, axis=1))
        weighed = np.linalg.solve(made.landmark_covariances(), away[..., None])[..., 0]
        distances += list(np.einsum("ni,ni->n", away, weighed))
    assert 2.0 < np.mean(nees) < 4.2  # 3 degrees of freedom: 95 % of 30-run means lie in 2.2 to 3.9
    assert np.sqrt(np.mean(np.square(off))) < 0.12
    assert 1.2 < np.mean(distances) < 3.2  # 2 degrees of freedom


def test_reading_covariances_does_not_change_the_filter() -> None:
    walk, read, plain = Walk(3), LandmarkFilter(), LandmarkFilter()
    for k, (ids, points) in enumerate(walk.seen[:70]):
        for made in (read, plain):
            if k:
                made.move(walk.motions[k - 1][:2], float(walk.motions[k - 1][2]), MOTION)
            if made is read:
                before = made.pose_covariance()
                made.landmark_covariances()
                np.testing.assert_array_equal(made.pose_covariance(), before)
            made.see(ids, points, np.tile(SIGHT, (len(ids), 1, 1)))
    for name, value in plain.snapshot().items():
        np.testing.assert_array_equal(read.snapshot()[name], value, err_msg=name)


def test_motion_without_a_measurement_is_not_scaled_by_the_noise_of_the_odometry() -> None:
    noisy = Consistency(nis=400.0, freedom=300.0, motion=100.0, variance=400.0, spread=600.0)
    moved, jumped = LandmarkFilter(), LandmarkFilter()
    moved.consistency = jumped.consistency = noisy
    moved.move(np.zeros(2), 0.0, MOTION)
    jumped.jump(MOTION)
    np.testing.assert_allclose(moved.pose_covariance(), 4.0 * MOTION, atol=1e-12)
    np.testing.assert_allclose(jumped.pose_covariance(), MOTION, atol=1e-12)


def test_a_loop_takes_the_drift_out() -> None:
    walk = Walk(3, rounds=1)
    odometry = LandmarkFilter()
    for motion in walk.motions:
        odometry.move(motion[:2], float(motion[2]), MOTION)
    made = walk.filtered()
    assert np.linalg.norm(errors(walk, made)[:2]) < 0.3 * np.linalg.norm(errors(walk, odometry)[:2])


def test_landmarks_without_identities_are_distinguished() -> None:
    for seed in range(5):
        walk = Walk(seed)
        made = walk.filtered(known=False)
        nearest = np.linalg.norm(made.landmarks[:, None] - walk.landmarks[None], axis=2)
        assert len(set(nearest.argmin(axis=1))) == len(made.ids), "no landmark twice in the map"
        assert nearest.min(axis=1).max() < 0.5


def test_a_sighting_between_two_landmarks_is_ignored_and_counted() -> None:
    made = LandmarkFilter(Association(gate=0.9, new=0.999999))
    spread = np.tile(SIGHT, (1, 1, 1))
    made.see([0], np.array([[2.0, 0.0]]), spread)
    assert made.see([-1], np.array([[2.0, 0.25]]), spread) == [-1]
    assert made.counts.ambiguous == 1
    assert made.see([-1], np.array([[2.0, 0.05]]), spread) == [0]
    assert made.see([-1], np.array([[2.0, 2.0]]), spread) == [1]


@given(st.floats(-0.5, 2), st.floats(-0.5, 0.5), st.floats(-3, 3), st.floats(0, 1))
def test_parts_of_a_step_make_the_whole(x: float, y: float, turn: float, share: float) -> None:
    step = np.array([x, y, turn])
    whole = transform_matrix([x, y, 0.0], quaternion_from_yaw(turn))
    np.testing.assert_allclose(_arc(step, 1.0), whole, atol=1e-9)
    rest = invert(_arc(step, share)) @ _arc(step, 1.0)
    np.testing.assert_allclose(_arc(step, share) @ rest, whole, atol=1e-9)


def test_operator_output_equals_the_filter() -> None:
    walk = Walk(7)
    result = play(LandmarkSlam(), walk.messages())
    pose, made = result["pose"][-1], walk.filtered()
    np.testing.assert_allclose(pose.position[:2], made.position, atol=1e-9)
    np.testing.assert_allclose(yaw_of(pose.orientation), made.heading, atol=1e-9)
    last = result["landmarks"][-1]
    np.testing.assert_allclose(last.positions, made.landmarks, atol=1e-9)
    correction = result["correction"][-1]
    odometry = walk.messages()["odometry"][-1]
    np.testing.assert_allclose(correction.matrix("odom") @ odometry.matrix(), pose.matrix(), atol=1e-9)


def test_restored_operator_resumes_alike() -> None:
    messages = Walk(4).messages()
    assert_resumes_alike(LandmarkSlam, list(zip(messages["odometry"], messages["sightings"], strict=True)), 50)


def test_polar_sightings_of_a_mounted_sensor_are_the_same_landmarks() -> None:
    walk = Walk(5, rounds=1)
    cartesian = walk.messages()
    T_base_sensor = transform_matrix([0.3, -0.1, 0.5], quaternion_from_yaw(0.7))
    extrinsics = Transforms.from_matrix(T_base_sensor, stamp=0, frame="base", child_frame="sensor")
    polar = []
    for message in cartesian["sightings"]:
        base = np.column_stack([message.positions, np.full(message.count, 0.9)])
        p = (base - T_base_sensor[:3, 3]) @ T_base_sensor[:3, :3]
        level = np.hypot(p[:, 0], p[:, 1])
        polar.append(
            LandmarkSightings(
                stamp=message.stamp,
                frame="sensor",
                ids=message.ids,
                ranges=np.hypot(level, p[:, 2]),
                bearings=np.arctan2(p[:, 1], p[:, 0]),
                elevations=np.arctan2(p[:, 2], level),
                covariances=np.tile(np.diag([0.05**2, 0.01**2, 0.01**2]), (message.count, 1, 1)),
            )
        )
    inputs = {"odometry": cartesian["odometry"], "sightings": polar, "extrinsics": [extrinsics]}
    result = play(LandmarkSlam(), inputs)
    found = result["landmarks"][-1]
    assert np.linalg.norm(found.positions - walk.landmarks[found.ids], axis=1).max() < 0.5


def test_bad_sightings_are_counted_and_survived() -> None:
    messages = Walk(1, rounds=1).messages()
    broken = []
    for message in messages["sightings"]:
        positions = np.array(message.positions)
        if len(positions):
            positions[0] = np.nan
        broken.append(message.replace(positions=positions))
    operator = LandmarkSlam()
    result = play(operator, {"odometry": messages["odometry"], "sightings": broken})
    assert np.isfinite(result["pose"][-1].position).all()
    assert operator.summary()["ignored, invalid"] == sum(len(m.positions) > 0 for m in broken)


def test_bad_odometry_is_counted_and_the_next_covers_both_steps() -> None:
    walk = Walk(1, rounds=1)
    messages = walk.messages()
    odometry = list(messages["odometry"])
    plain = play(LandmarkSlam(), messages)
    odometry[30] = odometry[30].replace(position=[np.nan, 0, 0])
    for k, C in ((45, np.full((6, 6), np.nan)), (46, -np.eye(6))):
        odometry[k] = odometry[k].replace(twist_covariance=C)
    operator = LandmarkSlam()
    result = play(operator, messages | {"odometry": odometry})
    assert len(result["pose"]) == len(plain["pose"]) - 1
    assert all(np.isfinite(p.position).all() and np.isfinite(p.pose_covariance).all() for p in result["pose"])
    off = result["pose"][-1].position - plain["pose"][-1].position
    assert np.linalg.norm(off) < 0.1
    counted = operator.summary()
    assert counted["ignored, odometry: not finite"] == 1
    assert counted["ignored, covariance of odometry: not finite or negative"] == 2


@pytest.mark.long
def test_odometry_reset_is_a_jump_and_landmarks_relocalize_the_robot() -> None:
    walk = Walk(2)
    messages = walk.messages()
    odometry = list(messages["odometry"])
    for k in range(70, len(odometry)):
        odometry[k] = odometry[k].replace(position=odometry[k].position + np.array([900.0, -400, 0]))
    operator = LandmarkSlam()
    result = play(operator, messages | {"odometry": odometry})
    assert operator.summary()["ignored, step of odometry: a jump"] == 1
    plain = play(LandmarkSlam(), messages)
    off = result["pose"][-1].position - plain["pose"][-1].position
    assert np.linalg.norm(off) < 0.1


def test_a_landmark_that_is_twice_in_a_message_counts_once() -> None:
    messages = Walk(1, rounds=1).messages()
    doubled = [m.replace(ids=np.zeros(m.count, np.int64)) if m.count > 1 else m for m in messages["sightings"]]
    operator = LandmarkSlam()
    play(operator, messages | {"sightings": doubled})
    expected = sum(m.count - 1 for m in doubled if m.count > 1)
    assert operator.summary()["ignored, twice in a message"] == expected > 0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"covariances": None}, "how well a landmark was seen must be known"),
        ({"frame": "mast"}, "no transform between 'mast' and 'base'"),
    ],
)
def test_sightings_without_covariance_or_place_are_refused(change: dict[str, Any], reason: str) -> None:
    messages = Walk(1, rounds=1).messages()
    wrong = [m.replace(**change) for m in messages["sightings"]]
    extrinsics = Transforms.from_matrix(np.eye(4), stamp=0, frame="base", child_frame="camera")
    with pytest.raises(Exception, match=reason):
        play(LandmarkSlam(), {**messages, "sightings": wrong, "extrinsics": [extrinsics]})


@pytest.mark.long
@pytest.mark.data
def test_victoria_park_is_mapped(data_dir: Path) -> None:
    from operators.sources.victoria_park import read_steps

    made = LandmarkFilter()
    for step in read_steps(data_dir / "landmark_slam" / "victoria_park.txt"):
        if step.covariance.any():
            made.move(step.motion[:2], float(step.motion[2]), step.covariance)
        if step.ids:
            made.see(step.ids, np.array(step.points), np.array(step.spreads))
            assert made.consistency.odometry_variance == 1.0, "too little motion between sightings to learn its noise"
    assert len(made.ids) == 151
    spread = np.sqrt(np.linalg.eigvalsh(made.landmark_covariances())[:, 1])
    assert spread.max() < 5.0
