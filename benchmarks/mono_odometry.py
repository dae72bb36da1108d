"""Monocular odometry on 7-Scenes and in simulated worlds: accuracy up to the scale, and in metres by wheels or depth.

    python benchmarks/mono_odometry.py recorded                        7-Scenes' colour images
    python benchmarks/mono_odometry.py worlds office:21 corridor:22    simulated worlds, kind and seed, 30 s at 10 Hz

ATE by evo over the frames that count as tracked; with scale (Sim(3)) and, where wheels or one depth image a second give
metres, without (SE(3)), from the frame on in which metres are known.
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
from operators.geometry.extrinsics import transform_between  # noqa: E402
from operators.odometry.mono.ranging import MetricDepth  # noqa: E402
from operators.odometry.mono.tracker import MonoOdometry  # noqa: E402
from operators.odometry.rgbd.camera import RgbdCamera  # noqa: E402
from operators.odometry.tracking import MEASURED  # noqa: E402

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drive:
    """Grey images (N, H, W), true camera poses (N, 4, 4), stamps (N,); the camera by the wheels where there are.

    Depth images have other stamps than the grey ones, by the camera's intrinsics and those of its neighbour.
    """

    image: NDArray[np.uint8]
    truth: Array
    stamps: NDArray[np.int64]
    camera: RgbdCamera
    depth: dict[int, NDArray[np.float32]]
    wheels: Array | None = None


def recorded(folder: Path) -> Drive:
    files = sorted(folder.glob("*.color.jpg"))
    if not files:
        raise SystemExit(f"no frame-NNNNNN.color.jpg in {folder}: give a 7-Scenes folder with --data")
    images = [cv2.cvtColor(np.asarray(cv2.imread(str(f), cv2.IMREAD_COLOR_RGB)), cv2.COLOR_RGB2GRAY) for f in files]
    truth = [se3.orthonormalised(np.loadtxt(f.with_name(f.name.replace("color.jpg", "pose.txt")))) for f in files]
    K_depth = np.loadtxt(folder / "camera-intrinsics.txt")
    K_color = K_depth.copy()
    K_color[0, 0] = K_color[1, 1] = 525.0
    stamps = np.arange(len(files)) * (10**9 // 30)
    return Drive(np.array(images), np.array(truth), stamps, RgbdCamera(K_color, K_depth), _depths(files, stamps))


def _depths(files: list[Path], stamps: NDArray[np.int64]) -> dict[int, NDArray[np.float32]]:
    """Returns one depth image a second, metres; the sensor's 65535 is no return."""
    found = {}
    for k in range(0, len(files), 30):
        file = files[k].with_name(files[k].name.replace("color.jpg", "depth.png"))
        raw = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        found[int(stamps[k])] = np.where(raw == 65535, 0, raw / 1000.0).astype(np.float32)
    return found


def simulated(cache: Path, world: str, seed: int, seconds: int) -> Drive:
    file = cache / f"{world}_{seed}_{seconds}s_depth.npz"
    if not file.is_file():
        _render(file, world, seed, seconds)
    d = np.load(file)
    camera = RgbdCamera(d["K"], d["K_depth"], d["T_depth_color"])
    depth = dict(zip(d["depth_stamps"].tolist(), d["depth"], strict=True))
    return Drive(d["image"], d["truth"], d["stamps"], camera, depth, d["wheels"])


def _render(file: Path, world: str, seed: int, seconds: int) -> None:
    from operators.simulator import SimulatedRobot

    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{seconds}s",
        color_camera={"rate": 10, "width": 640, "height": 480},
        depth_camera={"rate": 1},
        wheels={"rate": 10},
        truth={"poses": 10, "boxes": False, "relations": 0, "activities": 0},
    )
    robot.setup()
    static: dict[str, Any] = dict(robot.static_outputs())
    sent: list[dict[str, Any]] = [dict(m) for m in robot.stream()]
    messages, depths = [m for m in sent if "image" in m], [m["depth"] for m in sent if "depth" in m]
    depth_frame, color_frame = depths[0].frame, messages[0]["image"].frame
    T_depth_color = transform_between(static["extrinsics"], color_frame, depth_frame)
    truth = np.array([m["ground_truth"].matrix() @ T_depth_color for m in messages])
    T_base_camera = invert(messages[0]["true_base"].matrix()) @ truth[0]
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        file,
        image=np.array([cv2.cvtColor(m["image"].data, cv2.COLOR_RGB2GRAY) for m in messages]),
        truth=truth,
        stamps=np.array([m["image"].stamp for m in messages], np.int64),
        K=static["image_info"].K,
        K_depth=static["depth_info"].K,
        T_depth_color=T_depth_color,
        depth=np.array([d.data for d in depths]),
        depth_stamps=np.array([d.stamp for d in depths], np.int64),
        wheels=np.array([m["wheel_odometry"].matrix() @ T_base_camera for m in messages]),
    )


def ate(estimate: Array, truth: Array, scaled: bool) -> float:
    """RMSE in centimetres after alignment, with scale or without."""
    reference, path = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    path.align(reference, correct_scale=scaled)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    return float(100 * ape.get_statistic(metrics.StatisticsType.rmse))


def show(name: str, drive: Drive, metres: str) -> None:
    """Prints the row of a drive whose metres come from "wheels", from "depth", or from nothing ("unknown")."""
    odometry = MonoOdometry(drive.camera.K_color)
    results, spent = [], []
    for k, (image, stamp) in enumerate(zip(drive.image, drive.stamps.tolist(), strict=True)):
        told = drive.wheels[k] if metres == "wheels" and drive.wheels is not None else None
        seen = drive.depth.get(stamp) if metres == "depth" else None
        given = None if seen is None else MetricDepth(stamp, seen, drive.camera)
        begun = time.process_time()
        results.append(odometry.track(image, stamp, told, given))
        spent.append(1e3 * (time.process_time() - begun))
    good = np.array([r.track.status in MEASURED for r in results])
    known = good & np.array([r.scale.known for r in results])
    poses = np.array([r.track.T_world_camera for r in results])
    words = Counter(str(r.track.status) for r in results)
    words += Counter(f"depth {r.ranged.use}" for r in results if r.ranged is not None)
    metric, judged = ("-", good) if not known.any() else (f"{ate(poses[known], drive.truth[known], False):.2f}", known)
    path = float(np.linalg.norm(np.diff(drive.truth[:, :3, 3], axis=0), axis=1).sum())
    cells = [f"{path:.1f}", f"{ate(poses[judged], drive.truth[judged], True):.2f}", metric, f"{100 * good.mean():.1f}"]
    cells += [f"{value:.1f}" for value in (np.mean(spent), np.median(spent), np.percentile(spent, 95))]
    print(f"| {name} | {metres} | {' | '.join(cells)} |  {dict(words)}", flush=True)


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
        for metres in ("unknown", "depth"):
            show("7-Scenes", recorded(arguments.data), metres)
    for name in arguments.worlds:
        kind, _, seed = name.partition(":")
        drive = simulated(arguments.cache, kind, int(seed), arguments.seconds)
        for metres in ("unknown", "wheels", "depth"):
            show(f"{kind} {seed}", drive, metres)


if __name__ == "__main__":
    main()
