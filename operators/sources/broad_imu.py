"""A trial of the BROAD benchmark as a source: a nine-axis inertial sensor and its true orientation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Imu, MagneticField, Message, Pose
from dataflow.messages.geometry import normalize
from dataflow.operator import Out, Param, Source, SourceError
from operators.sources.pacing import frame_stamp

Array = NDArray[np.float64]
_SETS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4, "opt_pos": 3}


@dataclass(frozen=True)
class BroadTrial:
    """A trial as the file holds it; a row is NaN where nothing was measured.

    `gyroscope` (N, 3) in rad/s, `accelerometer` (N, 3) in m/s², `magnetometer` (N, 3) in µT, `orientations` (N, 4) as
    w, x, y, z from the sensor to east-north-up, `positions` (N, 3) in m; `movement` (N,) marks what is to be scored.
    """

    rate: float
    gyroscope: Array
    accelerometer: Array
    magnetometer: Array
    orientations: Array
    positions: Array
    movement: NDArray[np.bool_]


class BroadImu(Source):
    """Reads one HDF5 file of the BROAD benchmark.

    Sample k is stamped first_stamp + k / rate. The benchmark scores the phase of movement alone: `truth_of: movement`
    gives the truth there only, so that scores are those of the benchmark.
    Laidig et al., "BROAD: a benchmark for robust inertial orientation estimation", 2021.
    """

    imu: Out[Imu] = Out(doc="angular velocity and specific force")
    magnetic_field: Out[MagneticField] = Out(doc="of the same stamps, tesla; absent where it was not measured")
    ground_truth: Out[Pose] = Out(doc="true pose of the sensor in east-north-up, where its orientation is known")

    path: str = Param(doc="the file")
    truth_of: Literal["movement", "everything"] = Param("movement", doc="phases in which the truth is given")
    first_stamp: int = Param(0, ge=0, doc="stamp of the first sample", unit="ns")
    start: int = Param(0, ge=0, doc="first sample read")
    stop: int | None = Param(None, ge=1, doc="sample to stop before; none reads to the end")
    imu_frame: str = Param("imu", min_length=1, doc="frame of the sensor")
    world_frame: str = Param("world", min_length=1, doc="frame of the ground truth: east, north, up")

    def setup(self) -> None:
        """Raises SourceError, FileNotFoundError."""
        file = self.use_file(Path(self.path).expanduser())
        self._trial = read_trial(file)
        count = len(self._trial.gyroscope)
        self._samples = range(count)[self.start : self.stop]
        if not self._samples:
            raise SourceError(f"{file} has {count} samples: start={self.start}, stop={self.stop} leaves none")

    def length(self) -> int:
        return len(self._samples)

    def stream(self) -> Iterator[Mapping[str, Message]]:
        trial = self._trial
        known = np.asarray(np.isfinite(trial.orientations).all(axis=1))
        if self.truth_of == "movement":
            known = known & trial.movement
        magnetic = np.asarray(np.isfinite(trial.magnetometer).all(axis=1))
        for k in self._samples:
            stamp = frame_stamp(k, trial.rate, self.first_stamp)
            messages: dict[str, Message] = {
                "imu": Imu(
                    stamp=stamp,
                    frame=self.imu_frame,
                    angular_velocity=trial.gyroscope[k],
                    linear_acceleration=trial.accelerometer[k],
                )
            }
            if magnetic[k]:
                messages["magnetic_field"] = MagneticField(
                    stamp=stamp, frame=self.imu_frame, field=trial.magnetometer[k] * 1e-6
                )
            if known[k]:
                messages["ground_truth"] = Pose(
                    stamp=stamp,
                    frame=self.world_frame,
                    child_frame=self.imu_frame,
                    position=trial.positions[k],
                    orientation=normalize(np.roll(trial.orientations[k], -1)),
                )
            yield messages


def read_trial(file: Path) -> BroadTrial:
    """Reads a whole file. Raises SourceError."""
    try:
        with h5py.File(file) as content:
            rate = content.attrs.get("sampling_rate")
            found = {name: _data_set(file, content, name) for name in (*_SETS, "movement")}
    except OSError as error:
        raise SourceError(f"{file} is no HDF5 file: {error}") from None
    if rate is None or not np.isscalar(rate) or not 0 < float(rate) < np.inf:  # type: ignore[arg-type]
        raise SourceError(f"{file}: the attribute sampling_rate must be a number above 0, got {rate!r}")
    count = len(found["imu_gyr"])
    for name, columns in _SETS.items():
        if found[name].shape != (count, columns):
            raise SourceError(f"{file}: {name} must have the shape {(count, columns)}, got {found[name].shape}")
    if found["movement"].shape != (count,):
        raise SourceError(f"{file}: movement must have the shape {(count,)}, got {found['movement'].shape}")
    for name in ("imu_gyr", "imu_acc"):
        wrong = np.flatnonzero(~np.isfinite(found[name]).all(axis=1))
        if wrong.size:
            raise SourceError(f"{file}: {name} is not finite at sample {wrong[0]}")
    return BroadTrial(
        rate=float(rate),  # type: ignore[arg-type]
        gyroscope=found["imu_gyr"].astype(np.float64),
        accelerometer=found["imu_acc"].astype(np.float64),
        magnetometer=found["imu_mag"].astype(np.float64),
        orientations=found["opt_quat"].astype(np.float64),
        positions=found["opt_pos"].astype(np.float64),
        movement=found["movement"].astype(bool),
    )


def _data_set(file: Path, content: h5py.File, name: str) -> NDArray[np.generic]:
    if not isinstance(content.get(name), h5py.Dataset):
        raise SourceError(f"{file} has no data set {name!r}; it has {', '.join(content) or 'none'}")
    return np.asarray(content[name])
