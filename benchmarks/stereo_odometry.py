"""Stereo odometry on a KITTI odometry folder: drift and time, and what it makes of black images; one thread.

python benchmarks/stereo_odometry.py           drift and time; decoding is excluded
python benchmarks/stereo_odometry.py gaps      black images in the drive, and where the car is taken to be after
python benchmarks/stereo_odometry.py offsets   right images shifted, in the drive and on a made motorway
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import stereo_road  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.geometry.extrinsics import transform_between  # noqa: E402
from operators.odometry.stereo.adjustment import StereoRig  # noqa: E402
from operators.odometry.stereo.odometry import rig_of  # noqa: E402
from operators.odometry.stereo.tracker import StereoOdometry  # noqa: E402
from operators.odometry.tracking import MEASURED, TrackResult  # noqa: E402
from operators.simulator import SimulatedRobot  # noqa: E402
from operators.sources import KittiOdometry  # noqa: E402

Matrix = NDArray[np.float64]
PERIOD = 100_000_000  # nanoseconds


@dataclass(frozen=True, eq=False)
class Drive:
    """Left and right images (H, W), true poses (4, 4) of the left camera, the rig; 10 Hz."""

    left: list[NDArray[np.uint8]]
    right: list[NDArray[np.uint8]]
    truth: list[Matrix]
    rig: StereoRig


@dataclass(frozen=True)
class Gaps:
    """First black pairs, how many, and the metres from which on a pose is wrong."""

    begins: tuple[int, ...]
    lengths: tuple[int, ...]
    wrong: float


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


AFTER = 10  # pairs that follow a gap, at 10 Hz
STREET = Gaps((16, 22, 28), (6, 10, 16), 0.5)
ROOM = Gaps((60, 120, 180), (10, 20, 80), 0.2)


def gaps(name: str, drive: Drive, tried: Gaps, ways: Sequence[str]) -> None:
    """Prints where a robot is said to be after black images: it goes on, or comes back over where it had been."""
    for way in ways:
        count, known, wrong, worst, firsts = 0, 0, 0, 0.0, list[str]()
        for begin in tried.begins:
            odometry, last = _before(drive, begin)
            for length in tried.lengths:
                ahead = range(begin + length, min(begin + length + AFTER, len(drive.left)))
                after = ahead if way == "went on" else range(begin - 3, begin - 3 - AFTER, -1)
                off = _after(odometry, last, drive, begin, length, list(after))
                said = [k for k, metres in enumerate(off) if metres is not None]
                firsts.append(str(said[0]) if said else "-")
                metres = [m for m in off if m is not None]
                count, known = count + len(off), known + len(metres)
                wrong, worst = wrong + sum(m > tried.wrong for m in metres), max([worst, *metres])
        cells = f"{len(firsts)} | {count} | {known} | {known - wrong} | {wrong} | {worst:.2f}"
        print(f"| {name}, {way} | {cells} | {' '.join(firsts)} |", flush=True)


def _before(drive: Drive, begin: int) -> tuple[StereoOdometry, Matrix]:
    """Returns an odometry after the pairs before a gap, and its last pose."""
    odometry, T = StereoOdometry(drive.rig), np.eye(4)
    for k in range(begin):
        T = odometry.track(drive.left[k], drive.right[k], k * PERIOD).T_world_camera
    return odometry, T


def _after(
    before: StereoOdometry, last: Matrix, drive: Drive, begin: int, length: int, after: list[int]
) -> list[float | None]:
    """Returns by how many metres each pose after a gap is off, from the last before it; None where none is claimed."""
    odometry = StereoOdometry(drive.rig)
    odometry.state = before.state
    black = np.zeros_like(drive.left[0])
    for k in range(begin, begin + length):
        odometry.track(black, black, k * PERIOD)
    T_world_truth = last @ invert(drive.truth[begin - 1])
    off: list[float | None] = []
    for k, i in enumerate(after):
        found = odometry.track(drive.left[i], drive.right[i], (begin + length + k) * PERIOD)
        error = (T_world_truth @ drive.truth[i])[:3, 3] - found.T_world_camera[:3, 3]
        claimed = found.status in MEASURED and "unknown" not in found.reason
        off.append(float(np.linalg.norm(error)) if claimed else None)
    return off


def simulated(cache: Path, world: str) -> Drive:
    """Returns 30 s of a simulated robot's stereo pair at 10 Hz, rendered once."""
    kind, _, seed = world.partition(":")
    file = cache / f"stereo_{kind}_{seed}.npz"
    if not file.is_file():
        robot = SimulatedRobot(
            world=kind, seed=int(seed), duration="30s", color_camera={"rate": 0}, depth_camera={"rate": 0},
            stereo={"rate": 10, "width": 640, "height": 480},
            truth={"poses": 10, "boxes": False, "relations": 0, "activities": 0},
        )  # fmt: skip
        robot.setup()
        static: dict[str, Any] = dict(robot.static_outputs())
        T = transform_between(static["extrinsics"], static["left_info"].frame, "base_link")
        sent: list[dict[str, Any]] = [dict(m) for m in robot.stream()]
        rig = rig_of(static["left_info"], static["right_info"])
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            file,
            left=np.array([m["left"].data for m in sent]),
            right=np.array([m["right"].data for m in sent]),
            truth=np.array([m["true_base"].matrix() @ T for m in sent]),
            K=rig.K,
            baseline=rig.baseline,
        )
    d = np.load(file)
    return Drive(list(d["left"]), list(d["right"]), list(d["truth"]), StereoRig(d["K"], float(d["baseline"])))


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
        offset = odometry.state.offset.pixels
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


def offsets(name: str, drive: Drive, first: int) -> None:
    """Prints drift and squared errors in sigmas with right images shifted by whole pixels, forwards from a pair on and
    backwards."""
    for way, chosen in (("forwards", slice(first, None)), ("backwards", slice(None, None, -1))):
        truth = drive.truth[chosen]
        for pixels in (0, 1, -1, 2):
            odometry, results = StereoOdometry(drive.rig), list[TrackResult]()
            for k, (left, right) in enumerate(zip(drive.left[chosen], drive.right[chosen], strict=True)):
                results.append(odometry.track(left, np.roll(right, pixels, axis=1), k * PERIOD))
            estimate = [r.T_world_camera for r in results]
            end, segments = drift(estimate, truth)
            errors = [se3.log(invert(invert(truth[0]) @ T) @ found) for T, found in zip(truth, estimate, strict=True)]
            squared = [e @ np.linalg.solve(r.covariance, e) / 6 for e, r in zip(errors[1:], results[1:], strict=True)]
            cells = f"{end:.2f} | {segments:.2f} | {odometry.state.offset.pixels:.2f} | {np.median(squared):.2f}"
            print(f"| {name}, {way} | {pixels} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["drift", "gaps", "offsets"], nargs="?", default="drift")
    parser.add_argument("worlds", nargs="*", default=[], help="KIND:SEED of simulated worlds, for gaps")
    parser.add_argument("--cache", type=Path, default=Path("out") / "stereo_odometry", help="folder of rendered drives")
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "kitti_odometry_06"
    parser.add_argument(
        "--data", type=Path, default=data, help="a KITTI odometry sequence (default: the project's data)"
    )
    parser.add_argument("--motorways", type=int, nargs="*", default=[1, 2], help="seeds, for offsets")
    cv2.setNumThreads(1)
    arguments = parser.parse_args()
    if arguments.what == "gaps":
        print(
            "| after the gap | gaps | pairs | said to be known | right | wrong | worst m | first known after, pairs |"
        )
        print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |")
    if arguments.what == "offsets":
        print("| drive | shift px | end point % | 10-40 m segments % | offset px | NEES/6, median |")
        print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for world in arguments.worlds:
        gaps(world.replace(":", " "), simulated(arguments.cache, world), ROOM, ("went on",))
    if arguments.worlds:
        return
    source = KittiOdometry(path=str(arguments.data))
    source.setup()
    statics = source.static_outputs()
    rig = rig_of(statics["left_info"], statics["right_info"])  # type: ignore[arg-type]
    steps: list[Any] = list(source.stream())
    if arguments.what == "drift":
        drifts(steps, rig)
        return
    left, right = [step["left"].data for step in steps], [step["right"].data for step in steps]
    drive = Drive(left, right, [step["ground_truth"].matrix() for step in steps], rig)
    if arguments.what == "gaps":
        gaps("street", drive, STREET, ("went on", "came back"))
        return
    offsets("KITTI 06", drive, 12)
    for seed in arguments.motorways:
        offsets(f"motorway {seed}", Drive(*stereo_road.motorway(seed, 51), stereo_road.RIG), 0)


if __name__ == "__main__":
    main()
