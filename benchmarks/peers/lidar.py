"""Runs LiDAR odometries of others on stored scans; in a separate environment, started by lidar_odometry.py.

python benchmarks/peers/lidar.py SCANS.npz POSES.npz PEER

SCANS holds `stamps` (N,) ns, and for scan k `points_k` (M, 3) and, where they are known, `times_k` (M,), s after the
stamp; `near`, `far`, `rate`, `rows`, `columns` of the sensor, and `indoors`. One thread.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

EVALIO: dict[str, dict[str, Any]] = {
    "KissICP": {"max_num_threads": 1},
    "GenZICP": {},
    "MadICP": {"num_threads": 1, "realtime": False},
    "CTICP": {"ls_num_threads": 1, "motion_compensation": "CONSTANT_VELOCITY"},
    "LOAM": {},
    "FORM": {"num_threads": 1},
}


def kiss(data: Any, scans: list[Any]) -> tuple[list[Any], list[float]]:
    """kiss-icp with 1 m voxels, indoors 0.3 m."""
    from kiss_icp.config import parser
    from kiss_icp.kiss_icp import KissICP

    config = parser.load_config(None)
    config.mapping.voxel_size = 0.3 if data["indoors"] else 1.0
    config.data.deskew = scans[0][1] is not None
    config.data.min_range, config.data.max_range = float(data["near"]), float(data["far"])
    config.registration.max_num_threads = 1
    odometry = KissICP(config)
    poses, cpu = [], []
    for points, times in scans:
        share = np.zeros(0)
        if times is not None:
            share = (times - times.min()) / max(1e-9, float(times.max() - times.min()))
        begin = time.process_time()
        odometry.register_frame(points.astype(np.float64), share)
        cpu.append(time.process_time() - begin)
        poses.append(odometry.last_pose.copy())
    return poses, cpu


def vgicp(data: Any, scans: list[Any]) -> tuple[list[Any], list[float]]:
    """small_gicp: VGICP to a map of Gaussian voxels; no deskewing."""
    import small_gicp

    size = 0.3 if data["indoors"] else 1.0
    planes = small_gicp.GaussianVoxelMap(size)
    poses, cpu = list[Any](), list[float]()
    T, step = np.eye(4), np.eye(4)
    for points, _ in scans:
        begin = time.process_time()
        distance = np.linalg.norm(points, axis=1)
        cloud, _tree = small_gicp.preprocess_points(
            points[(distance > data["near"]) & (distance < data["far"])].astype(np.float64), size / 4, 10, 1
        )
        if poses:
            found = small_gicp.align(planes, cloud, T @ step, size, 1, 30).T_target_source
            step, T = np.linalg.inv(T) @ found, found
        planes.insert(cloud, T)
        cpu.append(time.process_time() - begin)
        poses.append(T)
    return poses, cpu


def evalio(name: str, data: Any, scans: list[Any], stamps: Any) -> tuple[list[Any], list[float]]:
    """One of evalio's pipelines with its defaults, one thread."""
    import evalio.pipelines
    from evalio.types import SE3, Duration, ImuParams, LidarMeasurement, LidarParams, Point, Stamp

    pipeline = getattr(evalio.pipelines, name)()
    params = {**pipeline.default_params(), **EVALIO[name]}
    if "deskew" in pipeline.default_params():
        params["deskew"] = scans[0][1] is not None
    if "voxel_size" in pipeline.default_params() and name == "KissICP":
        params["voxel_size"] = 0.3 if data["indoors"] else 1.0
    pipeline.set_params(params)
    rows, columns = int(data["rows"]), int(data["columns"])
    pipeline.set_lidar_params(
        LidarParams(num_rows=rows, num_columns=columns, min_range=float(data["near"]), max_range=float(data["far"]),
                    rate=float(data["rate"]))
    )  # fmt: skip
    pipeline.set_imu_params(ImuParams())
    pipeline.set_imu_T_lidar(SE3.identity())
    pipeline.initialize()
    poses, cpu = {}, []
    for (points, times), stamp in zip(scans, stamps, strict=True):
        elevation = np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=1))
        low, high = np.quantile(elevation, [0.001, 0.999])
        row = np.clip(np.rint((high - elevation) / (high - low) * (rows - 1)), 0, rows - 1).astype(int)
        turn = (np.arctan2(points[:, 1], points[:, 0]) + np.pi) / (2 * np.pi)
        column = np.clip(turn * columns, 0, columns - 1).astype(int)
        seconds = np.zeros(len(points)) if times is None else times - times.min()
        made = [
            Point(x=float(p[0]), y=float(p[1]), z=float(p[2]), t=Duration.from_sec(float(s)),
                  range=int(1000 * np.linalg.norm(p)), row=int(r), col=int(c))
            for p, s, r, c in zip(points, seconds, row, column, strict=True)
        ]  # fmt: skip
        if name in ("LOAM", "FORM"):  # these take every cell of the sensor, one point in each
            grid = {
                (k // columns, k % columns): Point(row=k // columns, col=k % columns) for k in range(rows * columns)
            }
            grid.update({(point.row, point.col): point for point in made})
            made = list(grid.values())
        measurement = LidarMeasurement(Stamp.from_nsec(int(stamp)), made)
        begin = time.process_time()
        pipeline.add_lidar(measurement)
        cpu.append(time.process_time() - begin)
        for at, pose in pipeline.saved_estimates():
            poses[at.to_nsec()] = pose.to_mat()
    return [poses.get(int(stamp), np.full((4, 4), np.nan)) for stamp in stamps], cpu


def main() -> None:
    scans_file, poses_file, peer = sys.argv[1:]
    data = np.load(scans_file)
    stamps = data["stamps"]
    scans = [(data[f"points_{k}"], data.get(f"times_{k}")) for k in range(len(stamps))]
    if peer in ("kiss", "vgicp"):
        poses, cpu = {"kiss": kiss, "vgicp": vgicp}[peer](data, scans)
    else:
        poses, cpu = evalio(peer, data, scans, stamps)
    np.savez(poses_file, poses=np.array(poses), cpu=np.array(cpu))


if __name__ == "__main__":
    main()
