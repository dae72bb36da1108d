"""The landmark file is read as it is written, and what is wrong in it is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataflow.messages.geometry import yaw_of
from dataflow.operator import SourceError
from operators.sources import VictoriaPark
from operators.sources.victoria_park import read_steps

TEXT = """ODOMETRY 0 1 1.0 0.0 1.5707963267948966 0.01 0 0 0.02 0 0.03
LANDMARK 1 7 2.0 -1.0 0.4 0.1 0.5
ODOMETRY 1 3 2.0 0.5 0.0 0.01 0.001 0.002 0.02 0.003 0.03
LANDMARK 3 7 0.5 0.0 0.4 0 0.4
LANDMARK 3 8 1.5 0.0 0.4 0 0.4
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "park.txt"
    made.write_text(TEXT)
    return made


def steps_of(file: Path) -> list[dict[str, object]]:
    source = VictoriaPark(path=str(file), period=0.5)
    source.setup()
    return [dict(step) for step in source.stream()]


def test_poses_are_dead_reckoned_and_stamped_by_the_period(file: Path) -> None:
    odometry = [step["odometry"] for step in steps_of(file)]
    assert [o.stamp for o in odometry] == [0, 500_000_000, 1_000_000_000]
    positions = [o.position[:2] for o in odometry]
    np.testing.assert_allclose(positions, [[0, 0], [1, 0], [0.5, 2]], atol=1e-12)
    np.testing.assert_allclose(yaw_of(odometry[2].orientation), np.pi / 2)


def test_a_twist_covariance_is_that_of_the_step(file: Path) -> None:
    spread = steps_of(file)[2]["odometry"].twist_covariance[np.ix_([0, 1, 5], [0, 1, 5])]
    expected = [[0.01, 0.001, 0.002], [0.001, 0.02, 0.003], [0.002, 0.003, 0.03]]
    np.testing.assert_allclose(spread * 0.5**2, expected)


def test_sightings_belong_to_their_pose(file: Path) -> None:
    steps = steps_of(file)
    assert "sightings" not in steps[0]
    seen = steps[1]["sightings"]
    assert seen.ids.tolist() == [7]
    np.testing.assert_allclose(seen.positions, [[2, -1]])
    np.testing.assert_allclose(seen.covariances, [[[0.4, 0.1], [0.1, 0.5]]])
    assert steps[2]["sightings"].ids.tolist() == [7, 8]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ODOMETRY 0 1 1.0 0.0\n", "line 1: ODOMETRY with 2 numbers"),
        ("LANDMARK 0 1 x y 1 0 1\n", "line 1: could not convert"),
        ("POSE 0 1 2 3\n", "line 1: POSE with 2 numbers"),
        ("LANDMARK 0 1 2.0 3.0 1 0 1\n", "not one chain; it begins at no pose"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, text: str, words: str) -> None:
    made = tmp_path / "bad.txt"
    made.write_text(text)
    with pytest.raises(SourceError, match=words):
        read_steps(made)


@pytest.mark.data
def test_victoria_park_is_one_chain(data_dir: Path) -> None:
    steps = read_steps(data_dir / "landmark_slam" / "victoria_park.txt")
    assert len(steps) == 6969
    assert sum(len(step.ids) for step in steps) == 3640
