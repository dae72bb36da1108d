"""Association of landmarks without identity: decided by constellations, never by one that looks near."""

from __future__ import annotations

import math

import numpy as np
import pytest
from operator_runs import assert_resumes_alike

from dataflow.messages import Level
from dataflow.testing import play
from operators.slam import LandmarkSlam
from operators.slam.landmarks.association import agreed_pairs, jointly_compatible
from operators.slam.landmarks.filter import LandmarkFilter
from tests.operators.slam.landmarks.test_slam import Walk

Array = np.ndarray
SPREAD = np.diag([0.05**2, 0.05**2])
PLACES = np.array([[2.0, 0.5], [3.1, -1.2], [4.4, 1.9], [1.2, -2.1], [5.3, -0.4], [2.6, 2.7]])


def see(made: LandmarkFilter, points: Array, times: int = 1) -> list[int]:
    for _ in range(times):
        found = made.see([-1] * len(points), points, np.tile(SPREAD, (len(points), 1, 1)))
    return found


def seen_from(pose: Array, places: Array) -> Array:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return (places - pose[:2]) @ np.array([[c, -s], [s, c]])


def test_landmark_constellation_corrects_drift_by_one_landmark_spacing() -> None:
    made = LandmarkFilter()
    see(made, PLACES, times=4)
    made.move(np.zeros(2), 0.0, np.diag([1.0, 1.0, 0.1**2]))
    true = np.array([1.1, -1.0, 0.08])
    for _ in range(6):
        see(made, seen_from(true, PLACES))
    assert len(made.ids) == len(PLACES)
    assert np.linalg.norm(made.position - true[:2]) < 0.15
    assert abs(made.heading - true[2]) < 0.05


def test_a_row_of_equal_distances_does_not_relocalise() -> None:
    row = np.array([[x, 1.5] for x in np.arange(-4.0, 5.0)])
    made = LandmarkFilter()
    see(made, row, times=4)
    made.move(np.zeros(2), 0.0, np.diag([1.0, 1.0, 0.01**2]))
    see(made, seen_from(np.array([0.5, 0.0, 0.0]), row[2:7]), times=6)
    assert made.counts.merged == 0, "half of the distance to either side explains as much"
    assert len(made.ids) == len(row) + 5


def test_a_turn_that_the_odometry_missed_is_found_by_the_landmarks() -> None:
    made = LandmarkFilter()
    see(made, PLACES, times=4)
    made.move(np.array([0.1, 0.0]), 0.0, np.diag([0.01**2, 0.01**2, 0.05**2]))
    true = np.array([0.1, 0.0, 0.3])
    found = see(made, seen_from(true, PLACES))
    assert found == [0, 1, 2, 3, 4, 5]
    assert abs(made.heading - true[2]) < 0.05


def test_a_robot_among_other_landmarks_than_expected_is_lost_until_it_is_back() -> None:
    made = LandmarkFilter()
    see(made, PLACES, times=4)
    assert made.state[0] == "mapped"
    elsewhere = np.array([[2.5, -0.4], [3.9, 0.6], [1.5, 1.5], [3.3, 2.0], [4.6, -1.5], [2.0, -1.5]])
    see(made, elsewhere, times=6)
    assert made.state[:2] == ("lost", Level.ERROR)
    assert np.sqrt(made.pose_covariance()[0, 0]) > 0.9, "a lost robot claims no place"
    see(made, PLACES, times=12)
    assert made.state[0] != "lost"


def test_sightings_that_fit_alone_but_not_together_are_left_out() -> None:
    common = np.full((3, 2), 0.5)
    shared = np.tile(np.eye(2) * 0.3**2, (3, 3)) + np.eye(6) * 0.05**2
    assert jointly_compatible(common, shared, 0.99) == [0, 1, 2]
    odd = common.copy()
    odd[1] = -0.5
    assert jointly_compatible(odd, shared, 0.99) == [0, 2]


def test_pairs_that_two_pairings_explain_alike_are_not_agreed() -> None:
    residuals = np.array([[0.1, 0.0], [-0.1, 0.0], [0.1, 0.0], [-0.1, 0.0]])
    covariance = np.eye(8) * 0.01**2
    for a, b in ((0, 2), (1, 3)):
        for k in (0, 1):
            covariance[2 * a + k, 2 * b + k] = covariance[2 * b + k, 2 * a + k] = 0.0
    covariance += 0.1**2 * np.tile(np.eye(2), (4, 4))
    conflicts = np.zeros((4, 4), bool)
    conflicts[0, 1] = conflicts[1, 0] = conflicts[2, 3] = conflicts[3, 2] = True
    assert agreed_pairs(residuals, covariance, conflicts, 0.1) == []
    nearer = residuals + np.array([0.1, 0.0])
    assert agreed_pairs(nearer[1::2], covariance[:4, :4], conflicts[1::2, 1::2], 0.01) == [0, 1]


def test_odometry_noisier_than_its_covariance_is_reported_and_the_map_stays_whole() -> None:
    walk, told = Walk(3), np.diag([0.007**2, 0.0035**2, 0.0035**2])
    made = LandmarkFilter()
    states = set()
    for k, (ids, points) in enumerate(walk.seen):
        if k:
            made.move(walk.motions[k - 1][:2], float(walk.motions[k - 1][2]), told)
        made.see([-1] * len(ids), points, np.tile(SPREAD, (len(ids), 1, 1)))
        states.add(made.state[0])
    assert "inconsistent" in states
    nearest = np.linalg.norm(made.landmarks[:, None] - walk.landmarks[None], axis=2)
    assert len(set(nearest.argmin(axis=1))) == len(made.ids)
    assert nearest.min(axis=1).max() < 0.5


@pytest.mark.long
@pytest.mark.parametrize("half", [40, 70])
def test_operator_without_identities_resumes_alike(half: int) -> None:
    messages = Walk(4).messages(known=False)
    assert_resumes_alike(LandmarkSlam, list(zip(messages["odometry"], messages["sightings"], strict=True)), half)


def test_status_is_sent_every_second_with_counts() -> None:
    result = play(LandmarkSlam(association="unknown"), Walk(2).messages(known=False))
    stamps = [status.stamp for status in result["status"]]
    assert len(stamps) >= 10
    assert np.diff(stamps).max() <= 10**9
    last = result["status"][-1]
    assert last.messages == ("mapped",)
    assert int(last.pairs(0)["landmarks"]) == len(result["landmarks"][-1].ids)
