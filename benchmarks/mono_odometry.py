"""Monocular odometry on 7-Scenes and in simulated worlds: accuracy up to the scale, and in metres by wheels.

    python benchmarks/mono_odometry.py recorded                        7-Scenes' colour images
    python benchmarks/mono_odometry.py worlds office:21 corridor:22    simulated worlds, kind and seed, 30 s at 10 Hz

ATE by evo over the frames that count as tracked; with scale (Sim(3)) and, where wheels give metres, without (SE(3)).
Simulated drives are rendered once and kept in --cache. One thread; rendering and decoding are not counted.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from evo.core import metrics  # noqa: E402
from evo.core.trajectory import PosePath3D  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry.mono_odometry import MonoOdometry  # noqa: E402
from operators.odometry.tracking import MEASURED  # noqa: E402

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drive:
    """Grey images (N, H, W), true camera poses (N, 4, 4), stamps (N,), K; the camera by the wheels where there are."""

    image: NDArray[np.uint8]
    truth: Array
    stamps: NDArray[np.int64]
    K: Array
    wheels: Array | None = None


def recorded(folder: Path) -> Drive:
    files = sorted(folder.glob("*.color.jpg"))
    if not files:
        raise SystemExit(f"no frame-NNNNNN.color.jpg in {folder}: give a 7-Scenes folder with --data")
    images = [cv2.cvtColor(np.asarray(cv2.imread(str(f), cv2.IMREAD_COLOR_RGB)), cv2.COLOR_RGB2GRAY) for f in files]
    truth = [se3.orthonormalised(np.loadtxt(f.with_name(f.name.replace("color.jpg", "pose.txt")))) for f in files]
    K = np.loadtxt(folder / "camera-intrinsics.txt")
    K[0, 0] = K[1, 1] = 525.0
    return Drive(np.array(images), np.array(truth), np.arange(len(files)) * (10**9 // 30), K)


def simulated(cache: Path, world: str, seed: int, seconds: int) -> Drive:
    file = cache / f"{world}_{seed}_{seconds}s.npz"
    if not file.is_file():
        _render(file, world, seed, seconds)
    d = np.load(file)
    return Drive(d["image"], d["truth"], d["stamps"], d["K"], d["wheels"])


def _render(file: Path, world: str, seed: int, seconds: int) -> None:
    from operators.sources import SimulatedRobot

    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{seconds}s",
        color_camera={"rate": 10, "width": 640, "height": 480},
        depth_camera={"rate": 0},
        wheels={"rate": 10},
        truth={"poses": 10, "boxes": False, "relations": 0, "activities": 0},
    )
    robot.setup()
    static: dict[str, Any] = dict(robot.static_outputs())
    messages: list[dict[str, Any]] = [dict(m) for m in robot.stream()]
    truth = np.array([m["ground_truth"].matrix() for m in messages])
    T_base_camera = invert(messages[0]["true_base"].matrix()) @ truth[0]
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        file,
        image=np.array([cv2.cvtColor(m["image"].data, cv2.COLOR_RGB2GRAY) for m in messages]),
        truth=truth,
        stamps=np.array([m["image"].stamp for m in messages], np.int64),
        K=static["image_info"].K,
        wheels=np.array([m["wheel_odometry"].matrix() @ T_base_camera for m in messages]),
    )


def ate(estimate: Array, truth: Array, scaled: bool) -> float:
    """RMSE in centimetres after alignment, with scale or without."""
    reference, path = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    path.align(reference, correct_scale=scaled)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    return float(100 * ape.get_statistic(metrics.StatisticsType.rmse))


def show(name: str, drive: Drive, wheels: bool) -> None:
    odometry = MonoOdometry(drive.K)
    results, spent = [], []
    for k, (image, stamp) in enumerate(zip(drive.image, drive.stamps.tolist(), strict=True)):
        told = drive.wheels[k] if wheels and drive.wheels is not None else None
        begun = time.process_time()
        results.append(odometry.track(image, stamp, told))
        spent.append(1e3 * (time.process_time() - begun))
    good = np.array([r.track.status in MEASURED for r in results])
    poses = np.array([r.track.T_world_camera for r in results])[good]
    words = dict(Counter(str(r.track.status) for r in results))
    metric = f"{ate(poses, drive.truth[good], scaled=False):.2f}" if wheels else "-"
    path = float(np.linalg.norm(np.diff(drive.truth[:, :3, 3], axis=0), axis=1).sum())
    cells = [f"{path:.1f}", f"{ate(poses, drive.truth[good], scaled=True):.2f}", metric, f"{100 * good.mean():.1f}"]
    cells += [f"{value:.1f}" for value in (np.mean(spent), np.median(spent), np.percentile(spent, 95))]
    print(f"| {name} | {'wheels' if wheels else 'unknown'} | {' | '.join(cells)} |  {words}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "rgbd_7scenes"
    parser.add_argument("what", choices=["recorded", "worlds"])
    parser.add_argument("worlds", nargs="*", default=[], help="KIND:SEED")
    parser.add_argument("--data", type=Path, default=data, help="a 7-Scenes folder (default: the project's data)")
    parser.add_argument("--cache", type=Path, default=Path("out") / "mono_odometry", help="folder of rendered drives")
    parser.add_argument("--seconds", type=int, default=30, help="of a drive")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print("| drive | scale | path m | ATE Sim(3) cm | ATE SE(3) cm | tracked % | mean ms | median | p95 |")
    print("| --- | --- |" + " ---: |" * 7)
    if arguments.what == "recorded":
        show("7-Scenes", recorded(arguments.data), wheels=False)
    for name in arguments.worlds:
        kind, _, seed = name.partition(":")
        drive = simulated(arguments.cache, kind, int(seed), arguments.seconds)
        for wheels in (False, True):
            show(f"{kind} {seed}", drive, wheels)


if __name__ == "__main__":
    main()
