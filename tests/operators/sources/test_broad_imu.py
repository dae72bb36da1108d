"""BROAD files are read as they are written, and what is wrong in them is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import BroadImu
from operators.sources.broad_imu import read_trial


def trial(file: Path, rate: float | None = 200.0, **changes: object) -> Path:
    sets: dict[str, object] = {
        "imu_gyr": np.arange(12.0).reshape(4, 3),
        "imu_acc": np.ones((4, 3)),
        "imu_mag": np.array([[20.0, 0, -40], [np.nan] * 3, [20, 0, -40], [20, 0, -40]]),
        "opt_quat": np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [np.nan] * 4, [0, 0, 0, 1]]),
        "opt_pos": np.zeros((4, 3)),
        "movement": np.array([False, True, True, True]),
    } | changes
    with h5py.File(file, "w") as made:
        if rate is not None:
            made.attrs["sampling_rate"] = rate
        for name, values in sets.items():
            if values is not None:
                made[name] = values
    return file


def test_a_broad_trial_in_tesla_with_the_truth_of_its_movement(tmp_path: Path) -> None:
    file = str(trial(tmp_path / "a.hdf5"))
    played = play(BroadImu(path=file))
    assert play(BroadImu(path=file)).digests() == played.digests()
    assert [m.stamp for m in played["imu"]] == [0, 5_000_000, 10_000_000, 15_000_000]
    assert [m.stamp for m in played["magnetic_field"]] == [0, 10_000_000, 15_000_000]
    np.testing.assert_allclose(played["magnetic_field"][0].field, [20e-6, 0, -40e-6])
    assert [m.stamp for m in played["ground_truth"]] == [5_000_000, 15_000_000]
    assert played["ground_truth"][0].orientation.tolist() == [1, 0, 0, 0]


def test_everything_known_is_given_if_asked(tmp_path: Path) -> None:
    played = play(BroadImu(path=str(trial(tmp_path / "a.hdf5")), truth_of="everything", start=0, stop=2))
    assert [m.stamp for m in played["ground_truth"]] == [0, 5_000_000]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"imu_mag": None}, "no data set 'imu_mag'; it has imu_acc"),
        ({"opt_quat": np.zeros((3, 4))}, r"opt_quat must have the shape \(4, 4\), got \(3, 4\)"),
        ({"movement": np.zeros(3, bool)}, r"movement must have the shape \(4,\)"),
        ({"imu_acc": np.full((4, 3), np.nan)}, "imu_acc is not finite at sample 0"),
        *(({"rate": rate}, "sampling_rate must be a number above 0") for rate in (0.0, float("nan"), None)),
    ],
)
def test_a_wrong_broad_file_is_named(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SourceError, match=words):
        read_trial(trial(tmp_path / "a.hdf5", **changes))


def test_file_that_is_no_broad_trial_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.hdf5").write_text("words")
    with pytest.raises(SourceError, match="no HDF5 file"):
        read_trial(tmp_path / "a.hdf5")
    with pytest.raises(SourceError, match="start=9, stop=None leaves none"):
        BroadImu(path=str(trial(tmp_path / "b.hdf5")), start=9).setup()


def test_a_part_of_a_trial_keeps_its_stamps(tmp_path: Path) -> None:
    source = BroadImu(path=str(trial(tmp_path / "a.hdf5")), start=2, first_stamp=7)
    played = play(source)
    assert [m.stamp for m in played["imu"]] == [10_000_007, 15_000_007]
    assert source.length() == 2


@pytest.mark.data
def test_a_real_trial_is_read(data_dir: Path) -> None:
    trial = read_trial(data_dir / "broad_imu" / "02_undisturbed_slow_rotation_B.hdf5")
    assert trial.gyroscope.shape == (53240, 3)
    assert trial.movement.sum() == 32280
