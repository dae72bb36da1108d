"""Stereo odometry on a KITTI odometry folder: drift and time, and what it makes of black images; one thread.

python benchmarks/stereo_odometry.py           drift and time; decoding is excluded
python benchmarks/stereo_odometry.py gaps      black images in the drive, and where the car is taken to be after
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.odometry.stereo_adjustment import StereoRig  # noqa: E402
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


def from_the_end(estimate: list[Matrix], truth: list[Matrix]) -> float:
    """Returns the error of the first position with the last pose aligned, in percent: no first orientation is in it."""
    true, found = ([invert(path[-1]) @ T for T in path] for path in (truth, estimate))
    way = sum(float(np.linalg.norm(b[:3, 3] - a[:3, 3])) for a, b in pairwise(true))
    return 100 * float(np.linalg.norm(found[0][:3, 3] - true[0][:3, 3])) / way


def turning(path: list[Matrix], first: int, last: int) -> Matrix:
    """Returns the rotation vectors (N, 3) between neighbouring poses, in mrad."""
    return np.array([1e3 * cv2.Rodrigues((invert(a) @ b)[:3, :3])[0].ravel() for a, b in pairwise(path)][first:last])


BEGINS, LENGTHS, AFTER = (16, 22, 28), (6, 10, 16), 10  # first black pair, how many, pairs that follow, at 10 Hz
WRONG = 0.5  # metres


def gaps(steps: list[Any], rig: StereoRig) -> None:
    """Prints where a car is said to be after black images: it went on, or drives backwards over where it had been."""
    print("| after the gap | gaps | pairs | said to be known | right | wrong | worst m | first known after, pairs |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |")
    for name in ("it went on", "it comes back"):
        count, known, wrong, worst, firsts = 0, 0, 0, 0.0, list[str]()
        for begin in BEGINS:
            for length in LENGTHS:
                ahead = range(begin + length, min(begin + length + AFTER, len(steps)))
                after = ahead if name == "it went on" else range(begin - 3, begin - 3 - AFTER, -1)
                off = _after(steps, rig, begin, length, list(after))
                said = [k for k, metres in enumerate(off) if metres is not None]
                firsts.append(str(said[0]) if said else "-")
                metres = [m for m in off if m is not None]
                count, known = count + len(off), known + len(metres)
                wrong, worst = wrong + sum(m > WRONG for m in metres), max([worst, *metres])
        cells = f"{len(firsts)} | {count} | {known} | {known - wrong} | {wrong} | {worst:.2f}"
        print(f"| {name} | {cells} | {' '.join(firsts)} |", flush=True)


def _after(steps: list[Any], rig: StereoRig, begin: int, length: int, after: list[int]) -> list[float | None]:
    """Returns by how many metres each pose after a gap is off, from the last before it; None where none is claimed."""
    odometry, period = StereoOdometry(rig), 10**8
    for k in range(begin):
        last = odometry.track(steps[k]["left"].data, steps[k]["right"].data, k * period).T_world_camera
    black = np.zeros_like(steps[0]["left"].data)
    for k in range(begin, begin + length):
        odometry.track(black, black, k * period)
    T_world_truth = last @ invert(steps[begin - 1]["ground_truth"].matrix())
    off: list[float | None] = []
    for k, i in enumerate(after):
        found = odometry.track(steps[i]["left"].data, steps[i]["right"].data, (begin + length + k) * period)
        error = (T_world_truth @ steps[i]["ground_truth"].matrix())[:3, 3] - found.T_world_camera[:3, 3]
        claimed = found.status in MEASURED and "unknown" not in found.reason
        off.append(float(np.linalg.norm(error)) if claimed else None)
    return off


def drifts(steps: list[Any], rig: StereoRig) -> None:
    """Prints drift and time forwards, backwards and from later pairs, and by how much turns differ from the truth."""
    print("| pairs | end point % | last pose aligned % | 10-40 m segments % | tracked | offset px | ms | CPU ms |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    whole: dict[str, list[Matrix]] = {}
    for name, chosen in (("all", steps), ("from 10", steps[10:]), ("from 12", steps[12:]), ("backwards", steps[::-1])):
        odometry = StereoOdometry(rig)
        estimate, truth, wall, cpu, tracked = list[Matrix](), list[Matrix](), list[float](), list[float](), 0
        for k, step in enumerate(chosen):
            before, cpu_before = time.perf_counter(), time.process_time()
            result = odometry.track(step["left"].data, step["right"].data, steps[k]["left"].stamp)
            wall.append(1e3 * (time.perf_counter() - before))
            cpu.append(1e3 * (time.process_time() - cpu_before))
            tracked += result.status in MEASURED
            estimate.append(result.T_world_camera)
            truth.append(step["ground_truth"].matrix())
        end, segments = drift(estimate, truth)
        offset = odometry.snapshot().offset
        cells = f"{end:.2f} | {from_the_end(estimate, truth):.2f} | {segments:.2f} | {tracked}/{len(estimate)}"
        print(f"| {name} | {cells} | {offset:.2f} | {np.median(wall):.0f} | {np.median(cpu):.0f} |")
        whole[name] = estimate
    forward, backward = whole["all"], whole["backwards"][::-1]
    truth = [step["ground_truth"].matrix() for step in steps]
    print("\n| turn from pair to pair, RMS of the three axes, mrad | pairs 0-12 | 12-50 |")
    print("| --- | ---: | ---: |")
    for name, a, b in (
        ("forwards and backwards differ by", forward, backward),
        ("forwards and the truth differ by", forward, truth),
        ("backwards and the truth differ by", backward, truth),
    ):
        off = [turning(a, *part) - turning(b, *part) for part in ((0, 12), (12, 50))]
        print(f"| {name} | {np.sqrt(np.mean(off[0] ** 2)):.2f} | {np.sqrt(np.mean(off[1] ** 2)):.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["drift", "gaps"], nargs="?", default="drift")
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "kitti_odometry_06"
    parser.add_argument(
        "--data", type=Path, default=data, help="a KITTI odometry sequence (default: the project's data)"
    )
    cv2.setNumThreads(1)
    arguments = parser.parse_args()
    source = KittiOdometry(path=str(arguments.data))
    source.setup()
    statics = source.static_outputs()
    rig = rig_of(statics["left_info"], statics["right_info"])  # type: ignore[arg-type]
    steps: list[Any] = list(source.stream())
    if arguments.what == "gaps":
        gaps(steps, rig)
    else:
        drifts(steps, rig)


if __name__ == "__main__":
    main()
