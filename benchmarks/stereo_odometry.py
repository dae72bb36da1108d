"""Drift and time of stereo odometry on a KITTI odometry folder, one thread; decoding is excluded."""

from __future__ import annotations

import argparse
import os
import sys
import time
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.odometry.stereo_odometry import StereoOdometry  # noqa: E402
from operators.odometry.stereo_visual_odometry import rig_of  # noqa: E402
from operators.odometry.tracking import MEASURED  # noqa: E402
from operators.sources import KittiOdometry  # noqa: E402

Matrix = NDArray[np.float64]


def drift(estimate: list[Matrix], truth: list[Matrix]) -> tuple[float, float]:
    """Returns the end-point error with the first pose aligned, and the mean over segments of 10-40 m, in percent."""
    true, found = ([invert(path[0]) @ T for T in path] for path in (truth, estimate))
    steps = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(true)]
    way = np.concatenate([[0.0], np.cumsum(steps)])
    segments = []
    for length in (10.0, 20.0, 30.0, 40.0):
        for i in range(len(true)):
            j = int(np.searchsorted(way, way[i] + length))
            if j < len(true):
                error = invert(invert(true[i]) @ true[j]) @ (invert(found[i]) @ found[j])
                segments.append(np.linalg.norm(error[:3, 3]) / (way[j] - way[i]))
    return 100 * float(np.linalg.norm(found[-1][:3, 3] - true[-1][:3, 3]) / way[-1]), 100 * float(np.mean(segments))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "kitti_odometry_06"
    parser.add_argument(
        "--data", type=Path, default=data, help="a KITTI odometry sequence (default: the project's data)"
    )
    cv2.setNumThreads(1)
    folder = parser.parse_args().data
    print("| from pair | end point % | 10-40 m segments % | tracked | disparity offset px | median ms | CPU median |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for start in (0, 10):
        source = KittiOdometry(path=str(folder), start=start)
        source.setup()
        statics = source.static_outputs()
        odometry = StereoOdometry(rig_of(statics["left_info"], statics["right_info"]))  # type: ignore[arg-type]
        estimate, truth, wall, cpu, tracked = list[Matrix](), list[Matrix](), list[float](), list[float](), 0
        for step in source.stream():
            before, cpu_before = time.perf_counter(), time.process_time()
            result = odometry.track(step["left"].data, step["right"].data, step["left"].stamp)  # type: ignore[attr-defined]
            wall.append(1e3 * (time.perf_counter() - before))
            cpu.append(1e3 * (time.process_time() - cpu_before))
            tracked += result.status in MEASURED
            estimate.append(result.T_world_camera)
            truth.append(step["ground_truth"].matrix())  # type: ignore[attr-defined]
        end, segments = drift(estimate, truth)
        cells = f"{end:.2f} | {segments:.2f} | {tracked}/{len(estimate)} | {odometry.snapshot().offset:.2f}"
        print(f"| {start} | {cells} | {np.median(wall):.0f} | {np.median(cpu):.0f} |")


if __name__ == "__main__":
    main()
