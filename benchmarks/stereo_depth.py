"""Scores stereo depth, and plain SGBM beside it, against the simulator's truth and from pair to pair on KITTI.

python benchmarks/stereo_depth.py --seeds 21 22
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages.geometry import invert, transform_points  # noqa: E402
from operators.depth.stereo_matching import MatchingConfig, StereoMatcher  # noqa: E402
from operators.geometry.pinhole import project, unproject  # noqa: E402
from operators.geometry.stereo import rectified_pair  # noqa: E402
from operators.image.preparation import grey_of  # noqa: E402
from operators.simulator import SimulatedRobot  # noqa: E402
from operators.sources import KittiOdometry  # noqa: E402

Disparity = NDArray[np.float32]
Match = Callable[[NDArray[np.uint8], NDArray[np.uint8]], Disparity]
CONFIG = MatchingConfig()
WORLDS = ("office", "corridor", "table_top")


def plain(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> Disparity:
    """OpenCV's SGBM with the same settings and its own left-right check."""
    c = CONFIG
    matcher: Any = cv2.StereoSGBM.create(
        0, c.disparities, c.block, c.small_step * c.block**2, c.large_step * c.block**2, disp12MaxDiff=int(c.tolerance),
        preFilterCap=31, uniquenessRatio=c.uniqueness, speckleWindowSize=c.speckle, speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    found = matcher.compute(left, right).astype(np.float32) / 16
    return np.where(found > 0, found, np.nan).astype(np.float32)


def ours(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> Disparity:
    return StereoMatcher(CONFIG).match(left, right).disparity


METHODS: dict[str, Match] = {"plain SGBM": plain, "StereoDepth": ours}


def simulated(world: str, seed: int) -> Iterator[tuple[float, NDArray[np.uint8], NDArray[np.uint8], Disparity]]:
    """Yields focal length times baseline, both images, and the true depth at the left one's pixels."""
    size = {"rate": 1, "width": 640, "height": 480}
    robot = SimulatedRobot(
        world=world, seed=seed, duration=6_000_000_000, color_camera={"rate": 0}, stereo=size,
        depth_camera=size | {"noise": 0, "quantum": 2e-4, "edge_holes": 0, "specks": 0, "grazing": 0, "max_range": 30},
        truth={"poses": 0, "relations": 0, "activities": 0},
    )  # fmt: skip
    robot.setup()
    infos: Any = robot.static_outputs()
    K, baseline = rectified_pair(infos["left_info"], infos["right_info"])
    for step in robot.stream():
        given: Any = step
        yield float(K[0, 0]) * baseline, given["left"].data, given["right"].data, given["depth"].data


def judged(found: Disparity, depth: Disparity, scale: float) -> list[float]:
    """Share measured; of the measured, those off by more than 1 and 3 pixels; median error; RMSE in metres; share of
    all pixels right within half a pixel."""
    known = depth > scale / CONFIG.disparities
    truth = scale / np.where(known, depth, 1)
    seen = known & np.isfinite(found)
    error = np.abs(found - truth)[seen]
    off = (scale / found - depth)[seen]
    share = seen.sum() / known.sum()
    right = (error < 0.5).sum() / known.sum()
    return [share, np.mean(error > 1), np.mean(error > 3), np.median(error), np.sqrt(np.mean(off**2)), right]


def worlds(seeds: list[int]) -> None:
    print("| world | method | measured | off > 1 px | off > 3 px | median px | RMSE m | right of all | CPU ms |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    everything: dict[str, list[list[float]]] = {name: [] for name in METHODS}
    for world in WORLDS:
        for seed in seeds:
            rows: dict[str, list[list[float]]] = {name: [] for name in METHODS}
            for scale, left, right, depth in simulated(world, seed):
                for name, match in METHODS.items():
                    before = time.process_time()
                    found = match(left, right)
                    spent = 1e3 * (time.process_time() - before)
                    rows[name].append([*judged(found, depth, scale), spent])
            for name, row in rows.items():
                everything[name] += row
                print(line(f"{world} {seed}", name, np.mean(row, axis=0)))
    for name, row in everything.items():
        print(line("all, mean", name, np.mean(row, axis=0)))
        worst = np.max(row, axis=0)
        worst[[0, 5]] = np.min(row, axis=0)[[0, 5]]
        print(line("all, worst", name, worst))


def line(world: str, name: str, row: Any) -> str:
    share, one, three, median, rmse, right, spent = row
    return (
        f"| {world} | {name} | {share:.3f} | {one:.4f} | {three:.4f} | {median:.3f} | {rmse:.3f} | {right:.3f} "
        f"| {spent:.0f} |"
    )


def kitti(folder: Path) -> None:
    """Carries the depths of a pair with the true motion into the next, and compares with what is measured there."""
    source = KittiOdometry(path=str(folder), start=10)
    source.setup()
    infos: Any = source.static_outputs()
    K, baseline = rectified_pair(infos["left_info"], infos["right_info"])
    scale = float(K[0, 0]) * baseline
    steps: list[Any] = list(source.stream())[::4]
    print("\n| method | measured | agree within 1 px | median difference px |\n| --- | ---: | ---: | ---: |")
    for name, match in METHODS.items():
        found = [match(grey_of(step["left"].data), grey_of(step["right"].data)) for step in steps]
        rows = []
        for a, b, before, after in zip(found, found[1:], steps, steps[1:], strict=False):
            T = invert(after["ground_truth"].matrix()) @ before["ground_truth"].matrix()
            v, u = np.nonzero(np.isfinite(a))
            points = unproject(np.column_stack([u, v]).astype(np.float64), K) * (scale / a[v, u])[:, None]
            moved = transform_points(T, points)
            there = np.rint(project(moved, K)).astype(np.int64)
            height, width = b.shape
            inside = (there >= 0).all(axis=1) & (there[:, 0] < width) & (there[:, 1] < height) & (moved[:, 2] > 1)
            seen = b[there[inside, 1], there[inside, 0]]
            apart = np.abs(seen - scale / moved[inside, 2])
            apart = apart[np.isfinite(apart)]
            rows.append([np.isfinite(a).mean(), np.mean(apart < 1), np.median(apart)])
        share, agree, median = np.mean(rows, axis=0)
        print(f"| {name} | {share:.3f} | {agree:.3f} | {median:.3f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "kitti_odometry_06"
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22], help="of the simulated worlds")
    parser.add_argument("--data", type=Path, default=data, help="a KITTI odometry sequence")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    worlds(arguments.seeds)
    if arguments.data.is_dir():
        kitti(arguments.data)


if __name__ == "__main__":
    main()
