"""EuRoC folders and BROAD files are read as they are written, and what is wrong in them is named."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from dataflow.messages import Message
from dataflow.testing import play
from operators.sources import BroadImu, EurocImu
from operators.sources.broad_imu import BroadError, read_trial
from operators.sources.euroc_imu import EurocError

IMU = "#stamp,gyro,accel\n100,0.1,0.2,0.3,1,2,3\n5000100,0.4,0.5,0.6,4,5,6\n"
TRUTH = "# t p q\n0.0000001 1 2 3 0 0 0 1\n0.00250 1 2 4 0 0 1 0\n"
SENSOR = "%YAML:1.0\nrate_hz: 200\ngyroscope_noise_density: 1.0e-04\naccelerometer_noise_density: 2.0e-3\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("imu.csv", IMU), ("groundtruth.txt", TRUTH), ("imu_sensor.yaml", SENSOR)):
        (tmp_path / name).write_text(text)
    return tmp_path


def trial(file: Path, **changes: object) -> Path:
    sets: dict[str, object] = {
        "imu_gyr": np.arange(12.0).reshape(4, 3),
        "imu_acc": np.ones((4, 3)),
        "imu_mag": np.array([[20.0, 0, -40], [np.nan] * 3, [20, 0, -40], [20, 0, -40]]),
        "opt_quat": np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [np.nan] * 4, [0, 0, 0, 1]]),
        "opt_pos": np.zeros((4, 3)),
        "movement": np.array([False, True, True, True]),
    } | changes
    with h5py.File(file, "w") as made:
        made.attrs["sampling_rate"] = 200.0
        for name, values in sets.items():
            if values is not None:
                made[name] = values
    return file


def test_euroc_stamps_are_exact_and_both_streams_keep_their_own(folder: Path) -> None:
    played = play(EurocImu(path=str(folder)))
    assert [m.stamp for m in played["imu"]] == [100, 5000100]
    assert [m.stamp for m in played["ground_truth"]] == [100, 2500000]
    assert played["imu"][1].linear_acceleration.tolist() == [4, 5, 6]  # type: ignore[attr-defined]
    assert played["ground_truth"][1].orientation.tolist() == [0, 0, 1, 0]  # type: ignore[attr-defined]


def test_euroc_densities_give_the_covariance_of_a_sample(folder: Path) -> None:
    sample = play(EurocImu(path=str(folder)))["imu"][0]
    np.testing.assert_allclose(sample.angular_velocity_covariance, np.eye(3) * 1e-8 * 200)  # type: ignore[attr-defined]
    np.testing.assert_allclose(sample.linear_acceleration_covariance, np.eye(3) * 4e-6 * 200)  # type: ignore[attr-defined]


def test_a_euroc_folder_without_truth_or_densities_gives_the_samples_alone(folder: Path) -> None:
    (folder / "groundtruth.txt").unlink()
    (folder / "imu_sensor.yaml").unlink()
    played = play(EurocImu(path=str(folder)))
    assert played["ground_truth"] == []
    assert played["imu"][0].angular_velocity_covariance is None  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("imu.csv", IMU + "5000100,0,0,0,0,0,0\n", "line 4: stamp 5000100 after 5000100"),
        ("imu.csv", IMU + "6000100,0,0,0\n", "line 4: 4 columns; expected a stamp in ns and 6 numbers"),
        ("imu.csv", IMU + "6000100,0,0,nan,0,0,0\n", "line 4: a number that is not finite"),
        ("imu.csv", IMU + "soon,0,0,0,0,0,0\n", "line 4: the stamp is no number"),
        ("imu.csv", "# nothing\n", "holds no line of a stamp"),
        ("groundtruth.txt", "1.0 0 0 0 1 1 0 0\n", "pose 1: .* is no unit quaternion"),
        ("imu_sensor.yaml", "rate_hz: 200\n", "gyroscope_noise_density must be a number above 0, got None"),
        ("imu_sensor.yaml", "rate_hz: [\n", "no YAML"),
    ],
)
def test_a_wrong_euroc_file_is_named(folder: Path, name: str, text: str, words: str) -> None:
    (folder / name).write_text(text)
    with pytest.raises(EurocError, match=words):
        EurocImu(path=str(folder)).setup()


def test_a_missing_euroc_folder_and_file_are_named(folder: Path) -> None:
    with pytest.raises(EurocError, match="no folder"):
        EurocImu(path=str(folder / "other")).setup()
    (folder / "imu.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"imu\.csv"):
        EurocImu(path=str(folder)).setup()


def test_a_broad_trial_in_tesla_with_the_truth_of_its_movement(tmp_path: Path) -> None:
    played = play(BroadImu(path=str(trial(tmp_path / "a.hdf5"))))
    assert [m.stamp for m in played["imu"]] == [0, 5_000_000, 10_000_000, 15_000_000]
    assert [m.stamp for m in played["magnetic_field"]] == [0, 10_000_000, 15_000_000]
    np.testing.assert_allclose(played["magnetic_field"][0].field, [20e-6, 0, -40e-6])  # type: ignore[attr-defined]
    assert [m.stamp for m in played["ground_truth"]] == [5_000_000, 15_000_000]
    assert played["ground_truth"][0].orientation.tolist() == [1, 0, 0, 0]  # type: ignore[attr-defined]


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
    ],
)
def test_a_wrong_broad_file_is_named(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    with pytest.raises(BroadError, match=words):
        read_trial(trial(tmp_path / "a.hdf5", **changes))


def test_what_is_no_broad_file_is_named(tmp_path: Path) -> None:
    text = tmp_path / "a.hdf5"
    text.write_text("words")
    with pytest.raises(BroadError, match="no HDF5 file"):
        read_trial(text)
    with h5py.File(text, "w") as made:
        made["imu_gyr"] = np.zeros((1, 3))
    with pytest.raises(BroadError, match="no data set 'imu_acc'"):
        read_trial(text)
    with pytest.raises(BroadError, match="start=9, stop=None leaves none"):
        BroadImu(path=str(trial(tmp_path / "b.hdf5")), start=9).setup()


@pytest.mark.data
def test_the_real_files_are_read(data_dir: Path) -> None:
    euroc = EurocImu(path=str(data_dir / "euroc_v1_01_imu"))
    euroc.setup()
    first: dict[str, Message] = dict(next(iter(euroc.stream())))
    assert first["imu"].stamp == 1403715273262142976
    assert euroc.length() > 50_000
    trial = read_trial(data_dir / "broad_imu" / "02_undisturbed_slow_rotation_B.hdf5")
    assert trial.gyroscope.shape == (53240, 3)
    assert trial.movement.sum() == 32280
