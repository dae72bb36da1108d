"""Orientation on BROAD: the operator against vqf called directly, RMSE over the phase of movement.

    python benchmarks/orientation.py DATA/broad_imu

The operator runs as a graph runs it, on messages; vqf directly takes the arrays of the file.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from vqf import VQF


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from operators.evaluation.orientation_metrics import differences, errors
    from operators.fusion import OrientationFilter
    from operators.sources import BroadImu
    from operators.sources.broad_imu import read_trial

    def rmse(q: np.ndarray, truth: np.ndarray, scored: np.ndarray) -> tuple[float, float]:
        total, _, inclination = errors(differences(q[scored], truth[scored]))
        return tuple(float(np.degrees(np.sqrt((e**2).mean()))) for e in (total, inclination))  # type: ignore[return-value]

    rows = []
    print("trial | 9-D total: vqf, operator | 6-D inclination: vqf, operator | µs a sample")
    for file in sorted(arguments.folder.glob("*.hdf5")):
        trial = read_trial(file)
        scored = trial.movement & np.isfinite(trial.orientations).all(axis=1)
        truth = np.roll(trial.orientations, -1, axis=1)
        direct = VQF(1 / trial.rate).updateBatch(
            np.ascontiguousarray(trial.gyroscope),
            np.ascontiguousarray(trial.accelerometer),
            np.ascontiguousarray(trial.magnetometer),
        )
        row = [
            rmse(np.roll(direct["quat9D"], -1, axis=1), truth, scored)[0],
            rmse(np.roll(direct["quat6D"], -1, axis=1), truth, scored)[1],
        ]
        source = BroadImu(path=str(file))
        source.setup()
        samples = list(source.stream())
        for heading, figure in (("magnetic", 0), ("relative", 1)):
            made = OrientationFilter(heading=heading)
            made.setup()
            began, estimates = time.process_time(), np.full((len(samples), 4), np.nan)
            for k, sample in enumerate(samples):
                given = made.process(sample["imu"], sample.get("magnetic_field"))  # type: ignore[arg-type]
                if given is not None:
                    estimates[k] = given["oriented"].orientation
            spent = (time.process_time() - began) / len(samples) * 1e6
            covered = scored & np.isfinite(estimates).all(axis=1)
            if covered.sum() != scored.sum():
                raise SystemExit(f"{file}: {scored.sum() - covered.sum()} samples that are scored have no estimate")
            row.append(rmse(estimates, truth, covered)[figure])
        rows.append(row)
        print(f"{file.stem} | {row[0]:.3f}°, {row[2]:.3f}° | {row[1]:.3f}°, {row[3]:.3f}° | {spent:.0f}", flush=True)
    mean = np.mean(rows, axis=0)
    print(f"mean | {mean[0]:.3f}°, {mean[2]:.3f}° | {mean[1]:.3f}°, {mean[3]:.3f}°")


if __name__ == "__main__":
    main()
