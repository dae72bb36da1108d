"""EuRoC folders are read as they are written, and what is wrong in them is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataflow.messages import Message
from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import EurocImu

IMU = "#stamp,gyro,accel\n100,0.1,0.2,0.3,1,2,3\n5000100,0.4,0.5,0.6,4,5,6\n"
TRUTH = "# t p q\n0.0000001 1 2 3 0 0 0 1\n0.00250 1 2 4 0 0 1 0\n"
SENSOR = "%YAML:1.0\nrate_hz: 200\ngyroscope_noise_density: 1.0e-04\naccelerometer_noise_density: 2.0e-3\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("imu.csv", IMU), ("groundtruth.txt", TRUTH), ("imu_sensor.yaml", SENSOR)):
        (tmp_path / name).write_text(text)
    return tmp_path


def test_euroc_stamps_are_exact_and_both_streams_keep_their_own(folder: Path) -> None:
    played = play(EurocImu(path=str(folder)))
    assert play(EurocImu(path=str(folder))).digests() == played.digests()
    assert [m.stamp for m in played["imu"]] == [100, 5000100]
    assert [m.stamp for m in played["ground_truth"]] == [100, 2500000]
    assert played["imu"][1].linear_acceleration.tolist() == [4, 5, 6]
    assert played["ground_truth"][1].orientation.tolist() == [0, 0, 1, 0]


def test_euroc_densities_give_the_covariance_of_a_sample(folder: Path) -> None:
    sample = play(EurocImu(path=str(folder)))["imu"][0]
    np.testing.assert_allclose(sample.angular_velocity_covariance, np.eye(3) * 1e-8 * 200)
    np.testing.assert_allclose(sample.linear_acceleration_covariance, np.eye(3) * 4e-6 * 200)


def test_a_euroc_folder_without_truth_or_densities_gives_the_samples_alone(folder: Path) -> None:
    (folder / "groundtruth.txt").unlink()
    (folder / "imu_sensor.yaml").unlink()
    (folder / "imu.csv").write_text("100,0.1,0.2,0.3,1,2,3\n")
    played = play(EurocImu(path=str(folder)))
    assert played["ground_truth"] == []
    assert [(m.stamp, m.frame) for m in played["imu"]] == [(100, "imu")]
    assert played["imu"][0].angular_velocity_covariance is None


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
    with pytest.raises(SourceError, match=words):
        EurocImu(path=str(folder), strict=True).setup()


@pytest.mark.parametrize("line", ["5000100,0,0,0,0,0,0", "6000100,0,0,0", "6000100,0,0,nan,0,0,0", "soon,0,0,0,0,0,0"])
def test_a_line_or_a_pose_that_is_none_is_passed_over_and_counted(folder: Path, line: str) -> None:
    (folder / "imu.csv").write_text("\ufeff" + IMU + line + "\n")
    (folder / "groundtruth.txt").write_text(TRUTH + "1.0 0 0 0 1 1 0 0\n")
    source = EurocImu(path=str(folder))
    played = play(source)

    assert [m.stamp for m in played["imu"]] == [100, 5000100]
    assert [m.stamp for m in played["ground_truth"]] == [100, 2500000]
    assert source.summary() == {"passed_over": 2}


def test_a_missing_euroc_folder_and_file_are_named(folder: Path) -> None:
    with pytest.raises(SourceError, match="no folder"):
        EurocImu(path=str(folder / "other")).setup()
    (folder / "imu.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"imu\.csv"):
        EurocImu(path=str(folder)).setup()


@pytest.mark.data
def test_the_real_sequence_is_read(data_dir: Path) -> None:
    source = EurocImu(path=str(data_dir / "euroc_v1_01_imu"))
    source.setup()
    first: dict[str, Message] = dict(next(iter(source.stream())))
    assert first["imu"].stamp == 1403715273262142976
    assert source.length() > 50_000
