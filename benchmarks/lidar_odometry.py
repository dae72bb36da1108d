"""LiDAR odometry, ours and others', on a drive of KITTI and in simulated worlds.

python benchmarks/lidar_odometry.py --peers ENVIRONMENT [--only kitti|worlds]

ENVIRONMENT is a virtual environment with kiss-icp, small-gicp and evalio; without one, ours runs alone. Times are of
the CPU, one thread, median of all scans and then the least of the rounds, which go in turns.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
import small_gicp  # noqa: E402
from lidar_worlds import Drive, rendered  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages import Odometry, PointCloud  # noqa: E402
from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry import LidarOdometry  # noqa: E402
from operators.sources import KittiRaw  # noqa: E402

Array = NDArray[np.float64]
DATA = Path(os.environ.get("PERCEPTION_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
WORLDS = tuple(f"{kind}:{seed}" for seed in (501, 502) for kind in ("office", "corridor", "table_top", "yard"))
PEERS = ("kiss", "vgicp", "KissICP", "GenZICP", "MadICP", "CTICP", "LOAM", "FORM")


@dataclass(frozen=True, eq=False)
class Outcome:
    """Poses (N, 4, 4), NaN where none was given, CPU seconds (N,), and what was said of the scans."""

    poses: Array
    cpu: Array
    said: str = ""
    nees: Array | None = None


def kitti() -> Drive:
    source = KittiRaw(path=str(DATA / "kitti_lidar_camera"))
    source.setup()
    clouds = [messages["points"] for messages in source.stream()]
    assert all(isinstance(cloud, PointCloud) for cloud in clouds)
    return Drive(clouds, [], {"near": 2.0, "far": 100.0, "rate": 10.0, "rows": 64, "columns": 2048, "indoors": False})  # type: ignore[arg-type]


def ours(drive: Drive) -> Outcome:
    operator = LidarOdometry(near=drive.sensor["near"])
    operator.setup()
    poses, cpu, nees = [], [], []
    for k, cloud in enumerate(drive.clouds):
        begin = time.process_time()
        messages = operator.process(cloud)
        cpu.append(time.process_time() - begin)
        odometry = messages.get("odometry")
        poses.append(odometry.matrix() if isinstance(odometry, Odometry) else np.full((4, 4), np.nan))
        if drive.truth and k and isinstance(odometry, Odometry) and odometry.pose_covariance is not None:
            off = se3.log(invert(invert(drive.truth[0]) @ drive.truth[k]) @ poses[-1])
            R = np.kron(np.eye(2), poses[-1][:3, :3])
            nees.append(off @ np.linalg.solve(R.T @ odometry.pose_covariance @ R, off) / 6)
    said = ", ".join(f"{name} {count}" for name, count in operator.summary().items() if count)
    return Outcome(np.array(poses), np.array(cpu), said, np.array(nees))


def peer(name: str, environment: Path) -> Callable[[Drive], Outcome]:
    def run(drive: Drive) -> Outcome:
        with tempfile.TemporaryDirectory() as folder:
            arrays: dict[str, Any] = {"stamps": [cloud.stamp for cloud in drive.clouds], **drive.sensor}
            for k, cloud in enumerate(drive.clouds):
                arrays[f"points_{k}"] = cloud.points
                if cloud.time_offsets is not None:
                    arrays[f"times_{k}"] = cloud.time_offsets
            scans, poses = Path(folder) / "scans.npz", Path(folder) / "poses.npz"
            np.savez(scans, **arrays)
            script = Path(__file__).parent / "peers" / "lidar.py"
            command = [str(environment / "bin" / "python"), str(script), str(scans), str(poses), name]
            done = subprocess.run(command, capture_output=True, text=True, timeout=900)
            count = len(drive.clouds)
            if done.returncode:
                return Outcome(np.full((count, 4, 4), np.nan), np.full(count, np.nan), done.stderr.strip()[-80:])
            found = np.load(poses)
            return Outcome(found["poses"], found["cpu"])

    return run


def direct(drive: Drive) -> Array:
    """Returns the pose of the last scan in the first by generalised ICP of the two, started from five metres ahead."""
    first, last = (drive.clouds[k].points.astype(np.float64) for k in (0, -1))
    guess = se3.exp(np.array([5.0, 0, 0, 0, 0, 0]))
    found = small_gicp.align(
        first, last, init_T_target_source=guess, downsampling_resolution=0.25, max_correspondence_distance=1.0,
        num_threads=1, max_iterations=100,
    )  # fmt: skip
    return np.asarray(found.T_target_source, np.float64)


def drift(poses: Array, truth: list[Array]) -> tuple[float, float, float]:
    """Returns ATE (cm, SE(3)-aligned), the error of the last pose from the first (cm, degrees)."""
    given = np.isfinite(poses[:, 0, 0])
    if not given[0] or not given[-1]:
        return math.nan, math.nan, math.nan
    estimate, true = poses[given], np.array(truth)[given]
    a, b = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (estimate, true))
    u, _, vt = np.linalg.svd(b.T @ a)
    off = a @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T - b
    end = se3.log(invert(invert(true[0]) @ true[-1]) @ invert(estimate[0]) @ estimate[-1])
    ate = 100 * float(np.sqrt(np.square(off).sum(axis=1).mean()))
    return ate, 100 * float(np.linalg.norm(end[:3])), math.degrees(np.linalg.norm(end[3:]))


def table_of_drive(runners: dict[str, Callable[[Drive], Outcome]], rounds: int, drive: Drive) -> None:
    reference = direct(drive)
    print("| odometry | end from direct GICP, cm | degrees | CPU ms a scan: median | worst | poses |")
    print("| --- " * 6 + "|")
    outcomes: dict[str, list[Outcome]] = {name: [] for name in runners}
    for _ in range(rounds):
        for name, run in runners.items():
            outcomes[name].append(run(drive))
    for name, found in outcomes.items():
        last = found[0].poses[-1]
        given = f"{np.isfinite(found[0].poses[:, 0, 0]).sum()} of {len(drive.clouds)}"
        if not np.isfinite(last).all():
            print(f"| {name} | - | - | - | - | {given} {found[0].said} |")
            continue
        off = se3.log(invert(reference) @ invert(found[0].poses[0]) @ last)
        cpu = [1e3 * f(o.cpu[1:]) for f in (np.median, np.max) for o in found]
        print(f"| {name} | {100 * np.linalg.norm(off[:3]):.1f} | {np.degrees(np.linalg.norm(off[3:])):.3f} "
              f"| {min(cpu[:rounds]):.1f} | {min(cpu[rounds:]):.1f} | {given} |")  # fmt: skip


def table_of_worlds(
    runners: dict[str, Callable[[Drive], Outcome]], worlds: list[tuple[str, int]], seconds: int, cache: Path
) -> None:
    print("| world | odometry | deskewed: ATE cm | end cm | end deg | as taken: ATE cm | end cm | CPU ms | said |")
    print("| --- " * 9 + "|")
    totals: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in runners}
    nees: list[Array] = []
    states: Counter[str] = Counter()
    for name, seed in worlds:
        drive = rendered(cache, name, seed, 70 if name == "corridor" else 60, 0.8).part(0, 10 * seconds)
        for label, run in runners.items():
            timed, plain = run(drive), run(drive.without_times())
            a, b = drift(timed.poses, drive.truth), drift(plain.poses, drive.truth)
            totals[label].append((a[0], a[1], b[0], b[1]))
            said = timed.said
            if timed.nees is not None:
                nees.append(timed.nees)
                states[said] += 1
                said += f"; NEES/6 median {np.median(timed.nees):.2f}, {np.mean(timed.nees > 12.59 / 6):.0%} above 95 %"
            print(f"| {name} {seed} | {label} | {a[0]:.2f} | {a[1]:.1f} | {a[2]:.2f} | {b[0]:.2f} | {b[1]:.1f} "
                  f"| {1e3 * np.median(timed.cpu):.1f} | {said} |", flush=True)  # fmt: skip
    print("\n| odometry | deskewed: mean ATE cm | worst | mean end cm | worst | as taken: mean ATE cm | worst |")
    print("| --- " * 7 + "|")
    for label, rows in totals.items():
        mean, worst = np.mean(rows, axis=0), np.max(rows, axis=0)
        print(f"| {label} | {mean[0]:.2f} | {worst[0]:.2f} | {mean[1]:.1f} | {worst[1]:.1f} "
              f"| {mean[2]:.2f} | {worst[2]:.2f} |")  # fmt: skip
    if nees:
        both = np.concatenate(nees)
        print(
            f"\nNEES/6 of all poses: median {np.median(both):.2f}, {np.mean(both > 12.59 / 6):.1%} above the 95 % bound"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, help="virtual environment with the peers")
    parser.add_argument("--only", choices=["kitti", "worlds"])
    parser.add_argument("--every", type=int, nargs="+", default=[1], help="of the drive's scans every n-th is taken")
    parser.add_argument("--first", type=int, default=0, help="the first of the drive's scans that is taken")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), help="KIND:SEED")
    parser.add_argument("--seconds", type=int, default=30, help="of each drive, of 60 or 70 s at 0.8 m/s")
    parser.add_argument("--cache", type=Path, default=Path("out") / "lidar_worlds", help="folder of rendered drives")
    parser.add_argument("--names", nargs="+", default=list(PEERS), help="which peers")
    arguments = parser.parse_args()
    runners: dict[str, Callable[[Drive], Outcome]] = {"ours": ours}
    if arguments.peers:
        runners |= {name: peer(name, arguments.peers) for name in arguments.names}
    if arguments.only != "worlds":
        whole = kitti()
        for step in arguments.every:
            print(f"Every {step}. scan:")
            clouds = whole.clouds[arguments.first :: step]
            table_of_drive(runners, arguments.rounds, Drive(clouds, [], whole.sensor | {"rate": 10.0 / step}))
    if arguments.only != "kitti":
        worlds = [(name, int(seed)) for name, _, seed in (given.partition(":") for given in arguments.worlds)]
        table_of_worlds(runners, worlds, arguments.seconds, arguments.cache)


if __name__ == "__main__":
    main()
