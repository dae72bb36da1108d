"""Which keyframes are kept, and which a lost view is compared with."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.geometry import se3
from operators.odometry.keyframes import RECALL_EVERY, recall_due, redundant, view_distance

SECOND = 1_000_000_000  # ns


def at(x: float, yaw: float = 0.0) -> NDArray[np.float64]:
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, yaw, 0.0]))
    T[0, 3] = x
    return T


def test_views_differ_by_baseline_over_depth_and_by_angle() -> None:
    assert view_distance(at(1.0), at(1.6, 0.2), 3.0) == pytest.approx(0.2 + 0.2)
    assert view_distance(at(1.0, 0.3), at(1.0, -0.2), 3.0) == pytest.approx(0.5)
    assert view_distance(at(2.0), at(2.0), 3.0) == 0.0
    assert view_distance(at(0.0), at(0.0, np.pi), 3.0) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("places", "recent", "expected"),
    [
        ([0.0, 1.0, 1.1, 2.0, 3.0, 4.0, 5.0], 2, 2),
        ([0.0, 1.0, 2.0, 2.1, 2.2, 4.0, 5.0], 2, 3),
        ([0.0, 0.0, 0.0, 1.0, 2.0], 1, 1),
        ([0.0, 3.0, 6.0, 9.0, 9.1, 9.2], 3, 1),
        ([0.0, 0.1], 5, 0),
    ],
    ids=["two near each other", "in a row", "of equal ones the first but one", "not among the newest", "no other"],
)
def test_most_redundant_keyframe_is_dropped(places: list[float], recent: int, expected: int) -> None:
    assert redundant([at(x) for x in places], recent) == expected


def test_recall_runs_at_every_frame_for_a_second_and_then_periodically() -> None:
    assert all(recall_due(7 * SECOND + k, 7 * SECOND, recalls) for k in (0, SECOND - 1) for recalls in range(3))
    later = [recall_due(8 * SECOND, 7 * SECOND, recalls) for recalls in range(2 * RECALL_EVERY)]
    assert later == [k % RECALL_EVERY == 0 for k in range(2 * RECALL_EVERY)]
    assert not any(recall_due(8 * SECOND, None, recalls) for recalls in range(3))
