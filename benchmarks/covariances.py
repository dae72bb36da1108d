"""Squared errors of odometry on recorded frames, in units of what its covariances claim: 1 where they are right.

    python benchmarks/covariances.py            RGB-D and stereo, forwards, backwards, and parts begun anew
    python benchmarks/covariances.py rgbd       RGB-D alone (or stereo)
    python benchmarks/covariances.py rgbd --depth-sensor kinect_v1      with its noise, not the usual figures
    python benchmarks/covariances.py truth      where depth alone contradicts the truth of 7-Scenes

Poses and covariances as emitted, relative to the first frame of a part.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import small_gicp  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial.transform import Rotation, Slerp  # noqa: E402
from scipy.stats import chi2  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.geometry.depth_sensors import read_depth_sensor  # noqa: E402
from operators.odometry.rgbd.odometry import camera_of  # noqa: E402
from operators.odometry.rgbd.settings import RgbdOdometryConfig  # noqa: E402
from operators.odometry.rgbd.surface import DepthNoise  # noqa: E402
from operators.odometry.rgbd.tracker import RgbdOdometry  # noqa: E402
from operators.odometry.stereo.odometry import rig_of  # noqa: E402
from operators.odometry.stereo.tracker import StereoOdometry  # noqa: E402
from operators.odometry.tracking import TrackResult  # noqa: E402
from operators.sources import KittiOdometry, RgbdFolder  # noqa: E402

Matrix = NDArray[np.float64]
Part = tuple[str, range]
EXACT, JITTER = np.zeros(6), np.array([2e-3] * 3 + [2e-3] * 3)  # metres and radians that poses of a truth err by


@dataclass(frozen=True, eq=False)
class Frames:
    """Holds the two images of each frame, stamps in nanoseconds, true poses (None where unknown), what makes the
    odometry, and the camera it is made for."""

    seen: list[tuple[Any, Any]]
    stamps: list[int]
    truth: list[Matrix | None]
    method: Callable[[Any], RgbdOdometry | StereoOdometry]
    camera: Any


def rgbd(folder: Path, sensor: str = "") -> Frames:
    """Reads a folder in the layout of 7-Scenes or TUM, of a depth sensor by its name."""
    source = RgbdFolder(path=str(folder))
    source.setup()
    static: dict[str, Any] = dict(source.static_outputs())
    camera = camera_of(static["image_info"], static["depth_info"], static["extrinsics"])
    steps: list[Any] = list(source.stream())
    truth = [step["ground_truth"].matrix() if "ground_truth" in step else None for step in steps]
    seen = [(step["image"].data, step["depth"].data) for step in steps]
    config = RgbdOdometryConfig(depth_noise=DepthNoise.of(read_depth_sensor(sensor)))
    method = partial(RgbdOdometry, config=config)
    return Frames(seen, [step["image"].stamp for step in steps], truth, method, camera)


def stereo(folder: Path) -> Frames:
    """Reads a sequence of KITTI odometry."""
    source = KittiOdometry(path=str(folder))
    source.setup()
    static: dict[str, Any] = dict(source.static_outputs())
    steps: list[Any] = list(source.stream())
    seen = [(step["left"].data, step["right"].data) for step in steps]
    truth = [step["ground_truth"].matrix() for step in steps]
    rig = rig_of(static["left_info"], static["right_info"])
    return Frames(seen, [step["left"].stamp for step in steps], truth, StereoOdometry, rig)


def later(frames: Frames, folder: Path, seconds: float) -> Frames:
    """Returns the frames of a folder in TUM's layout with the poses that its truth has so much later."""
    rows = np.loadtxt(folder / "groundtruth.txt")
    at = np.clip(np.array(frames.stamps) * 1e-9 + seconds, rows[0, 0], rows[-1, 0])
    truth = np.tile(np.eye(4), (len(at), 1, 1))
    truth[:, :3, :3] = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:8]))(at).as_matrix()
    truth[:, :3, 3] = np.column_stack([np.interp(at, rows[:, 0], rows[:, k]) for k in (1, 2, 3)])
    return replace(frames, truth=list(truth))


def both_ways(name: str, first: int, last: int) -> list[Part]:
    """Returns a part of a drive forwards and backwards."""
    return [(name, range(first, last + 1)), (f"{name}, backwards", range(last, first - 1, -1))]


def tracked(frames: Frames, chosen: range) -> list[TrackResult]:
    """Runs a new odometry over frames, at the stamps of as many neighbouring ones."""
    odometry, first = frames.method(frames.camera), min(chosen)
    return [odometry.track(*frames.seen[i], frames.stamps[first + k]) for k, i in enumerate(chosen)]


def squared(truth: list[Matrix | None], results: list[TrackResult], errs: Matrix) -> Matrix:
    """Returns the squared errors (N,) a degree of freedom, where each pose of the truth errs by `errs` (6,) as well."""
    first, jitter = truth[0], np.diag(errs**2)
    if first is None:
        raise SystemExit("the first frame of a part has no true pose: let it begin at another")
    out = []
    for T, found in zip(truth[1:], results[1:], strict=True):
        if T is None:
            continue
        T_first_truth = invert(first) @ T
        x = se3.log(invert(T_first_truth) @ found.T_world_camera)
        adjoint = se3.adjoint(invert(T_first_truth))
        covariance = found.covariance + jitter + adjoint @ jitter @ adjoint.T
        out.append(x @ np.linalg.solve(covariance, x) / 6)
    return np.array(out)


def table(name: str, frames: Frames, parts: list[Part], truths: list[tuple[str, list[Matrix | None], Matrix]]) -> None:
    """Prints a line for each part of a sequence, with each of several truths."""
    for part, chosen in parts:
        results = tracked(frames, chosen)
        for which, truth, errs in truths:
            values = squared([truth[i] for i in chosen], results, errs)
            quarters = ", ".join(f"{np.median(quarter):.2f}" for quarter in np.array_split(values, 4))
            above = 100 * np.mean(values > chi2.ppf(0.95, 6) / 6)
            cells = f"{len(chosen)} | {np.median(values):.2f} | {quarters} | {above:.0f}"
            print(f"| {name} {part} | {which} | {cells} |", flush=True)


def contradicted(frames: Frames, least: float) -> None:
    """Prints the steps of the truth from which the registration of depth by small_gicp differs by `least` metres."""
    for i in range(len(frames.truth) - 1):
        one, other = frames.truth[i], frames.truth[i + 1]
        if one is None or other is None:
            continue
        step = invert(one) @ other
        off = se3.log(invert(step) @ _registered(frames, i, i + 1, step))
        if np.linalg.norm(off[:3]) > least:
            size = [1e3 * np.linalg.norm(part) for part in (*np.split(se3.log(step), 2), *np.split(off, 2))]
            print(f"| {i} to {i + 1} | {size[0]:.0f} mm, {size[1]:.0f} mrad | {size[2]:.0f} mm, {size[3]:.0f} mrad |")


def apart(frames: Frames, first: int, others: range) -> None:
    """Prints by how much the odometry's motion from a frame to others, the truth's, and direct registration differ."""
    sign = 1 if others.step > 0 else -1
    chosen = range(first, others[-1] + sign, sign)
    for i, found in zip(chosen, tracked(frames, chosen), strict=True):
        one, other = frames.truth[first], frames.truth[i]
        if i not in others or one is None or other is None:
            continue
        T_truth = invert(one) @ other
        direct = _registered(frames, first, i, T_truth)
        cells = []
        for T_a, T_b in ((T_truth, found.T_world_camera), (T_truth, direct), (direct, found.T_world_camera)):
            metres, radians = (1e3 * np.linalg.norm(part) for part in np.split(se3.log(invert(T_a) @ T_b), 2))
            cells.append(f"{metres:.0f} mm, {radians:.0f} mrad")
        print(f"| {first} to {i} | {' | '.join(cells)} |")


def _registered(frames: Frames, i: int, j: int, T_guess: Matrix) -> Matrix:
    clouds = []
    for each in (i, j):
        depth, K = np.asarray(frames.seen[each][1][::6, ::6], np.float64), frames.camera.K_depth
        v, u = np.nonzero((depth > 0.3) & (depth < 4.0))
        z = depth[v, u]
        points = np.column_stack([(6 * u - K[0, 2]) / K[0, 0] * z, (6 * v - K[1, 2]) / K[1, 1] * z, z])
        clouds.append(small_gicp.preprocess_points(points, downsampling_resolution=0.03, num_threads=1))
    fit = small_gicp.align(
        clouds[0][0], clouds[1][0], clouds[0][1], init_T_target_source=T_guess,
        max_correspondence_distance=0.08, num_threads=1, max_iterations=40,
    )  # fmt: skip
    return np.asarray(fit.T_target_source)


def rgbd_tables(data: Path, sensor: str) -> None:
    seven, folder = rgbd(data / "rgbd_7scenes", sensor), data / "scenes" / "fr1_rpy"
    parts = [*both_ways("0-249", 0, 249), *both_ways("0-120", 0, 120), *both_ways("160-249", 160, 249)]
    table("7-Scenes", seven, parts, [("as it is", seven.truth, EXACT), ("errs by 2 mm, 2 mrad", seven.truth, JITTER)])
    rpy = rgbd(folder, sensor)
    parts = [*both_ways("0-274", 0, 274), *both_ways("0-136", 0, 136), *both_ways("137-274", 137, 274)]
    earlier = later(rpy, folder, -0.02).truth
    table("fr1_rpy", rpy, parts, [("as it is", rpy.truth, EXACT), ("20 ms earlier", earlier, EXACT)])


def stereo_tables(data: Path) -> None:
    kitti = stereo(data / "kitti_odometry_06")
    parts = [*both_ways("0-50", 0, 50), *both_ways("12-50", 12, 50), *both_ways("12-30", 12, 30)]
    table("KITTI 06", kitti, [*parts, *both_ways("31-50", 31, 50)], [("as it is", kitti.truth, EXACT)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["rgbd", "stereo", "all", "truth"], nargs="?", default="all")
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data")
    parser.add_argument("--data", type=Path, default=data, help="folder of shared data")
    parser.add_argument("--depth-sensor", default="", help="of RGB-D: kinect_v1 ... (default: usual figures)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.what == "truth":
        print("| frames | the truth's step | registration of depth differs by |\n| --- | --- | --- |")
        seven = rgbd(arguments.data / "rgbd_7scenes")
        contradicted(seven, 0.015)
        print("\n| frames | odometry and truth | direct registration and truth | odometry and registration |")
        print("| --- | --- | --- | --- |")
        for first, others in ((0, range(10, 31, 10)), (120, range(110, 79, -10)), (160, range(170, 201, 10))):
            apart(seven, first, others)
        return
    print("| drive | truth | frames | NEES/6, median | of its quarters | above 95 % bound, % |")
    print("| --- | --- | ---: | ---: | --- | ---: |")
    if arguments.what != "stereo":
        rgbd_tables(arguments.data, arguments.depth_sensor)
    if arguments.what != "rgbd":
        stereo_tables(arguments.data)


if __name__ == "__main__":
    main()
