"""Scores the registration of LiDAR scans without a guess, against the simulator's truth.

python benchmarks/registration.py --worlds office corridor --seeds 21 22
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from dataflow.messages import Odometry, PointCloud, Pose, Transforms  # noqa: E402
from dataflow.messages.geometry import invert, transform_points  # noqa: E402
from operators.cloud import CloudRegistration  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.sources import SimulatedRobot  # noqa: E402

Array = NDArray[np.float64]
NEAR, TURN = 0.1, 2.0  # metres and degrees within which a registration is right
SHARED = 0.2  # metres within which a point has one of the other scan


def scans(world: str, seed: int, count: int) -> list[tuple[PointCloud, Array]]:
    """Scans of a tour, with the true pose (4, 4) of the sensor."""
    rate, off = 0.25, {"rate": 0.0}
    truth_of: dict[str, Any] = {"poses": rate, "boxes": False, "relations": 0.0, "activities": 0.0}
    robot = SimulatedRobot(
        world=world, seed=seed, duration=f"{round(count / rate)}s", route="tour", color_camera=off, depth_camera=off,
        lidar={"rate": rate}, truth=truth_of,
    )  # fmt: skip
    robot.setup()
    mount = robot.static_outputs()["extrinsics"]
    assert isinstance(mount, Transforms)
    found = []
    for messages in robot.stream():
        cloud, base = messages.get("points"), messages.get("true_base")
        if isinstance(cloud, PointCloud) and isinstance(base, Odometry):
            found.append((cloud, base.matrix() @ mount.matrix("lidar")))
    return found


def overlap(one: tuple[PointCloud, Array], two: tuple[PointCloud, Array]) -> float:
    """Returns the share of the points of a scan that have one of the other nearby, the less of both directions."""
    a, b = (transform_points(T, cloud.points) for cloud, T in (one, two))
    return float(min((cKDTree(y).query(x)[0] < SHARED).mean() for x, y in ((a, b), (b, a))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=["office", "corridor", "table_top", "yard"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    parser.add_argument("--scans", type=int, default=8)
    parser.add_argument("--set", nargs="*", default=[], metavar="PARAM=VALUE", help="of CloudRegistration")
    parser.add_argument("--all", action="store_true", help="a line for each pair")
    arguments = parser.parse_args()
    params = {name: float(value) for name, value in (pair.split("=") for pair in arguments.set)}
    print(
        "| world | pairs sharing half | of them registered | others registered | wrong | error, cm: mean | worst | s |"
    )
    print("| --- " * 8 + "|")
    foreign: list[tuple[str, PointCloud]] = []
    for world in arguments.worlds:
        for seed in arguments.seeds:
            operator = CloudRegistration(**params)
            operator.setup()
            own = scans(world, seed, arguments.scans)
            counts: Counter[str] = Counter()
            errors, seconds = [], []
            pairs = [(i, j) for i in range(len(own)) for j in range(len(own)) if i < j]
            for i, j in pairs:
                shared = overlap(own[i], own[j])
                operator.seed_rng(i * 100 + j)
                begin = time.process_time()
                messages = operator.process(own[j][0], own[i][0])
                seconds.append(time.process_time() - begin)
                pose = messages.get("pose")
                due = "half" if shared >= 0.5 else "other"
                counts[due] += 1
                said = messages["status"].messages[0]  # type: ignore[attr-defined]
                off = np.zeros(6)
                if isinstance(pose, Pose):
                    off = se3.log(invert(invert(own[i][1]) @ own[j][1]) @ pose.matrix())
                    right = np.linalg.norm(off[:3]) <= NEAR and np.degrees(np.linalg.norm(off[3:])) <= TURN
                    counts[f"{due} registered"] += bool(right)
                    counts["wrong"] += not right
                    errors.append(100 * float(np.linalg.norm(off[:3])))
                if arguments.all:
                    print(f"{i} {j} shared {shared:.2f}, off {np.linalg.norm(off[:3]):.3f} m: {said}", flush=True)
            for _, cloud in foreign[-4:]:
                counts["foreign"] += 1
                operator.seed_rng(1)
                counts["wrong"] += "pose" in operator.process(cloud, own[0][0])
            foreign.append((world, own[0][0]))
            print(f"| {world} {seed} | {counts['half']} | {counts['half registered']} "
                  f"| {counts['other registered']} of {counts['other']} | {counts['wrong']} "
                  f"| {np.mean(errors) if errors else np.nan:.1f} | {max(errors, default=np.nan):.1f} "
                  f"| {np.median(seconds):.1f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
