"""Scores the registration of clouds without a guess: scans of simulated tours, of a car's LiDAR, and of a depth camera.

    python benchmarks/registration.py worlds office:501 corridor:501
    python benchmarks/registration.py kitti
    python benchmarks/registration.py 7scenes

Every cloud is laid onto every other one, in pairs, and onto clouds of other places. With --json, figures are added to a
file, of which `table --json FILE` prints the whole.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from dataflow.messages import Diagnostics, Message, Odometry, PointCloud, Pose, Transforms  # noqa: E402
from dataflow.messages.geometry import invert, transform_points  # noqa: E402
from operators.cloud import CloudRegistration  # noqa: E402
from operators.cloud.cloud_builder import Rays, within_range  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry import LidarOdometry  # noqa: E402
from operators.simulator import SimulatedRobot  # noqa: E402
from operators.sources import KittiRaw  # noqa: E402

Array = NDArray[np.float64]
Posed = tuple[PointCloud, Array]  # a cloud, and the true pose (4, 4) of its sensor
DATA = Path(os.environ.get("PERCEPTION_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
TURN = 3.0  # degrees within which a registration is right; and as many voxels as
NEAR = 2.0
SHARED = 2.0  # voxels within which a point has one of the other cloud

DEPTH = {"voxel": 0.05}
CAR = {"voxel": 0.5, "min_fitness": 0.8}


def scans(world: str, seed: int, count: int) -> list[Posed]:
    """Scans of a tour."""
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


def kitti(every: int) -> list[Posed]:
    """Scans of a car, and where `LidarOdometry` has them, which is right to about a centimetre."""
    source = KittiRaw(path=str(DATA / "kitti_lidar_camera"))
    source.setup()
    odometry = LidarOdometry(near=2.0)
    odometry.setup()
    found = []
    for k, messages in enumerate(source.stream()):
        cloud = messages["points"]
        assert isinstance(cloud, PointCloud)
        pose = odometry.process(cloud)["odometry"]
        assert isinstance(pose, Odometry)
        distance = np.linalg.norm(cloud.points, axis=1)
        if k % every == 0:
            kept = cloud.points[(distance > 2) & (distance < 50)]
            found.append((PointCloud(stamp=cloud.stamp, frame=cloud.frame, points=kept), pose.matrix()))
    return found


def seven_scenes(every: int) -> list[Posed]:
    """Clouds of a depth camera, x forward and z up, with the poses that come with them."""
    folder = DATA / "rgbd_7scenes"
    K = np.loadtxt(folder / "camera-intrinsics.txt")
    forward = np.eye(4)
    forward[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    found = []
    for k, file in enumerate(sorted(folder.glob("*.depth.png"))[::every]):
        raw = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        depth = np.where(raw == 65535, 0, raw).astype(np.float32) / np.float32(1000)
        rays = Rays.through(K, (depth.shape[1], depth.shape[0]), 2)
        points = rays.back_project(depth, within_range(depth, 2, 0.3, 4.0))
        points = transform_points(forward, points).astype(np.float32)
        T = se3.orthonormalised(np.loadtxt(str(file).replace(".depth.png", ".pose.txt")))
        found.append((PointCloud(stamp=k + 1, frame="depth", points=points), T @ invert(forward)))
    return found


def overlap(one: Posed, two: Posed, near: float) -> float:
    """Returns the share of the points of a cloud that have one of the other nearby, the less of both directions."""
    a, b = (transform_points(T, cloud.points[::3]) for cloud, T in (one, two))
    return float(min((cKDTree(y).query(x, distance_upper_bound=near)[0] < near).mean() for x, y in ((a, b), (b, a))))


def text(messages: dict[str, Message]) -> str:
    status = messages["status"]
    assert isinstance(status, Diagnostics)
    return status.messages[0]


def scored(
    name: str, own: list[Posed], foreign: list[PointCloud], params: dict[str, Any], each: bool
) -> dict[str, Any]:
    operator = CloudRegistration(**params)
    operator.setup()
    counts: Counter[str] = Counter()
    errors, turns, seconds = [], [], []
    near = float(operator.voxel)
    for i, j in [(i, j) for i in range(len(own)) for j in range(len(own)) if i < j]:
        shared = overlap(own[i], own[j], SHARED * near)
        operator.seed_rng(i * 100 + j)
        begin = time.process_time()
        messages = operator.process(own[j][0], own[i][0])
        seconds.append(time.process_time() - begin)
        pose, due = messages.get("pose"), "half" if shared >= 0.5 else "other"
        counts[due] += 1
        off = np.zeros(6)
        if isinstance(pose, Pose):
            off = se3.log(invert(invert(own[i][1]) @ own[j][1]) @ pose.matrix())
            right = np.linalg.norm(off[:3]) <= NEAR * near and np.degrees(np.linalg.norm(off[3:])) <= TURN
            counts[f"{due} registered"] += bool(right)
            counts["wrong"] += not right
            errors.append(100 * float(np.linalg.norm(off[:3])))
            turns.append(float(np.degrees(np.linalg.norm(off[3:]))))
        if each:
            print(
                f"{name} {i} {j} shared {shared:.2f}, off {np.linalg.norm(off[:3]):.3f} m: {text(messages)}", flush=True
            )
    for k, cloud in enumerate(foreign):
        counts["foreign"] += 1
        operator.seed_rng(k)
        counts["foreign registered"] += "pose" in operator.process(cloud, own[0][0])
    return {"name": name, **{key: counts[key] for key in KINDS}, "errors": errors, "turns": turns, "seconds": seconds}


KINDS = ("half", "half registered", "other", "other registered", "foreign", "foreign registered", "wrong")


def table(rows: list[dict[str, Any]]) -> None:
    print("| clouds | registered of pairs that share half | of other pairs | of clouds of other places | wrong "
          "| error cm: mean | worst | degrees: worst | CPU s: median | worst |")  # fmt: skip
    print(f"| --- |{' ---: |' * 9}")
    parts = ("errors", "turns", "seconds")
    whole = {"name": "**all**", **{k: sum(row[k] for row in rows) for k in KINDS}} | {
        part: [x for row in rows for x in row[part]] for part in parts
    }
    for row in [*rows, whole]:
        errors, turns = (row[part] or [np.nan] for part in ("errors", "turns"))
        found = (f"{row[f'{kind} registered']} of {row[kind]}" for kind in ("half", "other", "foreign"))
        print(f"| {row['name']} | {' | '.join(found)} | {row['wrong']} | {np.mean(errors):.1f} | {max(errors):.1f} "
              f"| {max(turns):.2f} | {np.median(row['seconds']):.1f} | {max(row['seconds']):.1f} |")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["worlds", "kitti", "7scenes", "table"])
    parser.add_argument("worlds", nargs="*", help="KIND:SEED")
    parser.add_argument("--scans", type=int, default=8, help="of a tour")
    parser.add_argument(
        "--every", type=int, default=0, help="frames of a recording: 4 of the car's, 20 of the camera's"
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="PARAM=VALUE", help="of CloudRegistration")
    parser.add_argument("--all", action="store_true", help="a line for each pair")
    parser.add_argument("--json", type=Path, help="file to which the figures are added")
    arguments = parser.parse_args()
    known = json.loads(arguments.json.read_text()) if arguments.json and arguments.json.is_file() else []
    if arguments.what == "table":
        table(known)
        return
    given = {name: float(value) for name, value in (pair.split("=") for pair in arguments.set)}
    rows: list[dict[str, Any]] = []
    if arguments.what == "kitti":
        rows.append(scored("KITTI drive", kitti(arguments.every or 4), [], CAR | given, arguments.all))
    elif arguments.what == "7scenes":
        rows.append(scored("7-Scenes", seven_scenes(arguments.every or 20), [], DEPTH | given, arguments.all))
    foreign: list[PointCloud] = []
    for world, _, seed in (name.partition(":") for name in arguments.worlds):
        own = scans(world, int(seed), arguments.scans)
        rows.append(scored(f"{world} {seed}", own, foreign[-4:], given, arguments.all))
        foreign += [own[0][0], own[4][0]]
    table(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(known + rows) + "\n")


if __name__ == "__main__":
    main()
