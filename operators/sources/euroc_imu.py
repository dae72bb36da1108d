"""The inertial part of a EuRoC sequence as a source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dataflow.messages import Imu, Message, Pose
from dataflow.messages.geometry import normalize
from dataflow.operator import Out, Param, Source, SourceError
from operators.passed_over import PassedOver

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InertialNoise:
    """White-noise densities of gyroscope (rad/s/√Hz) and accelerometer (m/s²/√Hz), and the rate in Hz."""

    gyroscope: float
    accelerometer: float
    rate: float


@dataclass(frozen=True)
class Samples:
    """Rows of a file: stamps (N,) in ns, strictly increasing, and the numbers (N, K) beside them."""

    stamps: list[int]
    values: Array


class EurocImu(Source):
    """Reads the inertial measurements of a EuRoC sequence and its true trajectory.

    The folder holds `imu.csv` (ns, gyroscope in rad/s, accelerometer in m/s²), and where they are known
    `groundtruth.txt` (s, x y z, qx qy qz qw: the pose of the inertial sensor) and `imu_sensor.yaml` (noise densities,
    which give every sample its covariance). A line that cannot be read is passed over with a warning, and so is a pose
    that is none. Burri et al., "The EuRoC micro aerial vehicle datasets", 2016.
    """

    imu: Out[Imu] = Out(doc="angular velocity and specific force, with the covariances of the file's densities")
    ground_truth: Out[Pose] = Out(doc="true pose of the inertial sensor, at its own stamps")

    path: str = Param(doc="the folder")
    imu_frame: str = Param("imu", min_length=1, doc="frame of the inertial sensor")
    world_frame: str = Param("world", min_length=1, doc="frame of the ground truth, z up")
    strict: bool = Param(False, doc="what cannot be read is an error, instead of being passed over and counted")

    def setup(self) -> None:
        """Raises SourceError."""
        folder = Path(self.path).expanduser()
        if not folder.is_dir():
            raise SourceError(f"no folder {folder}")
        self._passed = PassedOver(self.log, strict=self.strict)
        self._imu = read_imu(self.use_file(folder / "imu.csv"), self._passed)
        truth, sensor = folder / "groundtruth.txt", folder / "imu_sensor.yaml"
        self._truth = (
            read_truth(self.use_file(truth), self._passed) if truth.is_file() else Samples([], np.zeros((0, 7)))
        )
        self._noise = read_noise(self.use_file(sensor)) if sensor.is_file() else None

    def summary(self) -> Mapping[str, int]:
        return {"passed_over": self._passed.number}

    def length(self) -> int:
        return len(set(self._imu.stamps) | set(self._truth.stamps))

    def stream(self) -> Iterator[Mapping[str, Message]]:
        noise = self._noise
        gyro = None if noise is None else np.eye(3) * noise.gyroscope**2 * noise.rate
        accel = None if noise is None else np.eye(3) * noise.accelerometer**2 * noise.rate
        readings = dict(zip(self._imu.stamps, self._imu.values, strict=True))
        poses = dict(zip(self._truth.stamps, self._truth.values, strict=True))
        for stamp in sorted(readings.keys() | poses.keys()):
            messages: dict[str, Message] = {}
            if (row := readings.get(stamp)) is not None:
                messages["imu"] = Imu(
                    stamp=stamp,
                    frame=self.imu_frame,
                    angular_velocity=row[:3],
                    linear_acceleration=row[3:],
                    angular_velocity_covariance=gyro,
                    linear_acceleration_covariance=accel,
                )
            if (row := poses.get(stamp)) is not None:
                messages["ground_truth"] = Pose(
                    stamp=stamp,
                    frame=self.world_frame,
                    child_frame=self.imu_frame,
                    position=row[:3],
                    orientation=normalize(row[3:]),
                )
            yield messages


def read_imu(file: Path, passed: PassedOver) -> Samples:
    """Reads `imu.csv`: gyroscope and accelerometer (N, 6). Raises SourceError, OSError."""
    wanted = "a stamp in ns and 6 numbers: gyroscope in rad/s, accelerometer in m/s²"
    return _rows(file, ",", 6, Decimal(1), wanted, passed)


def read_truth(file: Path, passed: PassedOver) -> Samples:
    """Reads `groundtruth.txt`: position and quaternion (x, y, z, w) (N, 7). Raises SourceError, OSError."""
    wanted = "seconds and 7 numbers: x y z qx qy qz qw"
    truth = _rows(file, None, 7, Decimal(10) ** 9, wanted, passed)
    right = np.abs(np.linalg.norm(truth.values[:, 3:], axis=1) - 1) < 1e-2
    for pose in np.flatnonzero(~right):
        passed.take(SourceError(f"{file}, pose {pose + 1}: {truth.values[pose, 3:].tolist()} is no unit quaternion"))
    return Samples([stamp for stamp, good in zip(truth.stamps, right, strict=True) if good], truth.values[right])


def read_noise(file: Path) -> InertialNoise:
    """Reads the densities of `imu_sensor.yaml`. Raises SourceError, OSError."""
    text = file.read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]  # OpenCV's own header is no YAML
    try:
        content = YAML(typ="safe").load("\n".join(lines))
    except YAMLError as error:
        raise SourceError(f"{file}: no YAML: {error}") from None
    found = []
    for key in ("gyroscope_noise_density", "accelerometer_noise_density", "rate_hz"):
        value = content.get(key) if isinstance(content, dict) else None
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
            raise SourceError(f"{file}: {key} must be a number above 0, got {value!r}")
        found.append(float(value))
    return InertialNoise(*found)


def _rows(file: Path, separator: str | None, columns: int, scale: Decimal, wanted: str, passed: PassedOver) -> Samples:
    stamps: list[int] = []
    values: list[list[float]] = []
    refused: list[SourceError] = []
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise SourceError(f"{file} is no text in UTF-8: {error}") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.strip().split(separator)
        try:
            stamp, row = int(Decimal(words[0]) * scale), [float(word) for word in words[1:]]
            if len(row) != columns:
                raise ValueError(f"{len(words)} columns")
            if not np.isfinite(row).all():
                raise ValueError("a number that is not finite")
            if stamps and stamp <= stamps[-1]:
                raise ValueError(f"stamp {stamp} after {stamps[-1]}")
        except (ValueError, InvalidOperation, OverflowError) as error:
            reason = "the stamp is no number" if isinstance(error, InvalidOperation) else error
            refused.append(SourceError(f"{file}, line {number}: {reason}; expected {wanted}, stamps increasing"))
            continue
        stamps.append(stamp)
        values.append(row)
    if not stamps:
        raise refused[0] if refused else SourceError(f"{file} holds no line of {wanted}")
    for refusal in refused:
        passed.take(refusal)
    return Samples(stamps, np.array(values))
