"""Accuracy and time of RGB-D odometry on a 7-Scenes folder, beside three peers in the same process, one thread.

    python benchmarks/visual_odometry.py                                    7-Scenes
    python benchmarks/visual_odometry.py worlds                             twelve simulated worlds, movers on
    python benchmarks/visual_odometry.py worlds office:811 corridor:812     others, kind and seed

Peers: frame-to-frame ORB + RANSAC PnP (OpenCV), depth-only generalised ICP to a local map (small_gicp), and the dense
frame-to-model SLAM on a TSDF grid of Open3D.
Decoding is excluded. The methods take turns frame by frame, so load on the machine falls on all alike.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import odometry_worlds  # noqa: E402
import small_gicp  # noqa: E402
from evo.core import metrics  # noqa: E402
from evo.core.trajectory import PosePath3D  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry.rgbd.camera import RgbdCamera  # noqa: E402
from operators.odometry.rgbd.settings import RgbdOdometryConfig  # noqa: E402
from operators.odometry.rgbd.tracker import RgbdOdometry  # noqa: E402
from operators.odometry.tracking import TrackResult  # noqa: E402
from operators.simulator.rendering.native import open3d  # noqa: E402

Matrix = NDArray[np.float64]
Track = Callable[[NDArray[np.uint8], NDArray[np.float32], int], Matrix]


class OrbFrameToFrame:
    """ORB matched with the last frame, RANSAC PnP on its depth: the usual first thing to try."""

    def __init__(self, camera: RgbdCamera) -> None:
        self.camera, self.T = camera, np.eye(4)
        self.orb = cv2.ORB.create(1000)
        self.matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self.last: Any = None

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> Matrix:
        keypoints, descriptors = self.orb.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        pixels = np.array([k.pt for k in keypoints]).reshape(-1, 2)
        points, known = self.camera.depth_at(pixels, depth, 0.3, 6.0)
        if self.last is not None:
            last_points, last_known, last_descriptors = self.last
            pairs = [(m.queryIdx, m.trainIdx) for m in self.matcher.match(last_descriptors, descriptors)]
            a, b = np.array([p for p in pairs if last_known[p[0]]]).T
            ok, r, t, _ = cv2.solvePnPRansac(
                last_points[a],
                pixels[b],
                self.camera.K_color,
                None,
                iterationsCount=200,
                reprojectionError=3.0,
            )
            if ok:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = cv2.Rodrigues(r)[0], t.ravel()
                self.T = se3.orthonormalised(self.T @ invert(T))
        self.last = points, known, descriptors
        return self.T


class GicpLocalMap:
    """Generalised ICP of the thinned depth cloud to a map of the last keyframes; constant velocity start."""

    def __init__(self, camera: RgbdCamera) -> None:
        K = camera.K_depth
        self.K, self.T, self.step = K, np.eye(4), np.eye(4)
        self.keyframes: list[tuple[Matrix, NDArray[np.float64]]] = []
        self.target: Any = None

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> Matrix:
        z = depth[::8, ::8].astype(np.float64)
        v, u = np.nonzero((z > 0.3) & (z < 6.0))
        z = z[v, u]
        x, y = (8 * u - self.K[0, 2]) / self.K[0, 0], (8 * v - self.K[1, 2]) / self.K[1, 1]
        points = np.column_stack([x * z, y * z, z])
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.04, num_threads=1)
        if self.target is not None:
            fit = small_gicp.align(
                *self.target[:1], cloud, self.target[1], init_T_target_source=self.T @ self.step,
                max_correspondence_distance=0.1, num_threads=1, max_iterations=20,
            )  # fmt: skip
            T = se3.orthonormalised(np.asarray(fit.T_target_source))
            self.step, self.T = invert(self.T) @ T, T
        if not self.keyframes or self._moved():
            self.keyframes = [*self.keyframes, (self.T, points)][-8:]
            local = np.concatenate([p @ T[:3, :3].T + T[:3, 3] for T, p in self.keyframes])
            self.target = small_gicp.preprocess_points(local, downsampling_resolution=0.04, num_threads=1)
        return self.T

    def _moved(self) -> bool:
        x = se3.log(invert(self.keyframes[-1][0]) @ self.T)
        return bool(np.linalg.norm(x[:3]) > 0.1 or np.linalg.norm(x[3:]) > 0.1)


def read(folder: Path) -> tuple[list[tuple[NDArray[np.uint8], NDArray[np.float32]]], list[Matrix]]:
    frames, truth = [], []
    for file in sorted(folder.glob("*.color.jpg")):
        stem = file.name.split(".")[0]
        raw = np.asarray(cv2.imread(str(folder / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED))
        depth = np.where(raw == 65535, 0, raw).astype(np.float32) / np.float32(1000)
        frames.append((np.asarray(cv2.imread(str(file), cv2.IMREAD_COLOR_RGB), np.uint8), depth))
        truth.append(se3.orthonormalised(np.loadtxt(folder / f"{stem}.pose.txt")))
    if not frames:
        raise SystemExit(f"no frame-NNNNNN.color.jpg in {folder}: give a 7-Scenes folder with --data")
    return frames, truth


def score(estimate: list[Matrix], truth: list[Matrix], delta: int) -> dict[str, float]:
    """ATE RMSE after SE(3) alignment, and RPE RMSE over `delta` frames."""
    reference, path = PosePath3D(poses_se3=truth), PosePath3D(poses_se3=estimate)
    out = {}
    for name, relation in (
        ("rpe_cm", metrics.PoseRelation.translation_part),
        ("rpe_deg", metrics.PoseRelation.rotation_angle_deg),
    ):
        rpe = metrics.RPE(relation, delta, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, path))
        out[name] = rpe.get_statistic(metrics.StatisticsType.rmse) * (100 if name == "rpe_cm" else 1)
    path.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    return {"ate_cm": 100 * ape.get_statistic(metrics.StatisticsType.rmse), **out}


class Open3dFrameToModel:
    """Open3D's dense SLAM: each frame is tracked against what a TSDF grid of the ones before shows from the last pose.

    Settings are those of its example `dense_slam.py`, with voxels of 5.8 mm.
    """

    FAR, TRUNCATION = 3.0, 8.0

    def __init__(self, camera: RgbdCamera, shape: tuple[int, ...]) -> None:
        self.native = native = open3d()
        slam, device = native.t.pipelines.slam, native.core.Device("CPU:0")
        K = native.core.Tensor(np.ascontiguousarray(camera.K_depth))
        self.model = slam.Model(0.0058, 16, 40_000, native.core.Tensor(np.eye(4)), device)
        self.frame, self.seen = (slam.Frame(shape[0], shape[1], K, device) for _ in range(2))
        self.T = np.eye(4)
        self.number = 0

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> Matrix:
        millimetres = np.where(np.isfinite(depth), 1e3 * depth, 0).astype(np.uint16)
        self.frame.set_data_from_image("depth", self.native.t.geometry.Image(millimetres))
        self.frame.set_data_from_image("color", self.native.t.geometry.Image(np.ascontiguousarray(image)))
        if self.number:
            fit = self.model.track_frame_to_model(self.frame, self.seen, 1000.0, self.FAR, 0.07)
            self.T = self.T @ fit.transformation.numpy()
        self.model.update_frame_pose(self.number, self.native.core.Tensor(self.T))
        self.model.integrate(self.frame, 1000.0, self.FAR, self.TRUNCATION)
        self.model.synthesize_model_frame(self.seen, 1000.0, 0.1, self.FAR, self.TRUNCATION, False)
        self.number += 1
        return self.T


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["recorded", "worlds"], nargs="?", default="recorded")
    parser.add_argument("worlds", nargs="*", default=[], help="KIND:SEED (default: twelve that nothing is tuned on)")
    parser.add_argument("--cache", type=Path, default=Path("out") / "visual_odometry", help="folder of rendered drives")
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "rgbd_7scenes"
    parser.add_argument("--data", type=Path, default=data, help="a 7-Scenes folder (default: the project's data)")
    parser.add_argument("--stride", type=int, default=1, help="use every stride-th frame: faster motion")
    parser.add_argument("--color-focal", type=float, default=525.0, help="focal length of the colour camera, px")
    parser.add_argument("--delta", type=int, default=30, help="frames over which RPE is taken")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args()


def main() -> None:
    arguments = options()
    cv2.setNumThreads(1)
    if arguments.what == "worlds":
        odometry_worlds.table(arguments.worlds or list(odometry_worlds.WORLDS), arguments.cache)
        return

    frames, truth = read(arguments.data)
    frames, truth = frames[:: arguments.stride], truth[:: arguments.stride]
    K_depth = np.loadtxt(arguments.data / "camera-intrinsics.txt")
    K_color = K_depth.copy()
    K_color[0, 0] = K_color[1, 1] = arguments.color_focal
    camera = RgbdCamera(K_color, K_depth)

    results: dict[str, list[TrackResult]] = {"full": [], "features only": []}

    def ours(name: str, config: RgbdOdometryConfig) -> Track:
        odometry = RgbdOdometry(camera, config)

        def track(image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> Matrix:
            results[name].append(odometry.track(image, depth, stamp))
            return results[name][-1].T_world_camera

        return track

    methods: dict[str, Track] = {
        "full": ours("full", RgbdOdometryConfig()),
        "features only": ours("features only", RgbdOdometryConfig(refine=False)),
        "ORB frame to frame": OrbFrameToFrame(camera).track,
        "small_gicp depth only": GicpLocalMap(camera).track,
        "Open3D frame to model": Open3dFrameToModel(camera, frames[0][1].shape).track,
    }
    poses: dict[str, list[Matrix]] = {name: [] for name in methods}
    times: dict[str, list[float]] = {name: [] for name in methods}
    cpu: dict[str, list[float]] = {name: [] for name in methods}  # of all threads
    period = arguments.stride * 1_000_000_000 // 30
    for i, (image, depth) in enumerate(frames):
        for name, track in methods.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            T = track(image, depth, i * period)
            cpu[name].append(1e3 * (time.process_time() - cpu_start))
            times[name].append(1e3 * (time.perf_counter() - start))
            poses[name].append(T)

    base = float(np.median(cpu["full"]))
    table: list[dict[str, Any]] = []
    for name in methods:
        row: dict[str, Any] = {"method": name, **score(poses[name], truth, min(arguments.delta, len(frames) - 1))}
        row |= {**spread(times[name], "ms"), **spread(cpu[name], "cpu_ms")}
        row["cpu_ratio"] = row["median_cpu_ms"] / base
        if name in results:
            row["statuses"] = dict(Counter(str(r.status) for r in results[name]))
            row["keyframes"] = sum(r.keyframe for r in results[name])
        table.append(row)
    if arguments.json:
        print(json.dumps({"frames": len(frames), "stride": arguments.stride, "methods": table}, indent=2))
    else:
        print(f"{len(frames)} frames, stride {arguments.stride}; RPE over {arguments.delta} frames; one thread\n")
        report(table)


def spread(spent: list[float], label: str) -> dict[str, float]:
    return {f"median_{label}": float(np.median(spent)), f"p95_{label}": float(np.percentile(spent, 95))}


def report(table: list[dict[str, Any]]) -> None:
    print("| method | ATE cm | RPE cm | RPE deg | median ms | p95 ms | CPU median | CPU p95 | CPU / full |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for row in table:
        cells = [row[k] for k in ("ate_cm", "rpe_cm", "rpe_deg")]
        spent = [row[k] for k in ("median_ms", "p95_ms", "median_cpu_ms", "p95_cpu_ms")]
        numbers = [*(f"{c:.2f}" for c in cells), *(f"{t:.1f}" for t in spent), f"{row['cpu_ratio']:.2f}"]
        print(f"| {row['method']} | {' | '.join(numbers)} |")


if __name__ == "__main__":
    main()
