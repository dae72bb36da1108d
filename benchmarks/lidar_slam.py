"""LiDAR SLAM in simulated worlds: its drift beside that of the odometry in front of it and of kiss-icp, and saved maps.

    python benchmarks/lidar_slam.py worlds office:501 corridor:501 --peers VENV     rounds, deskewed and as taken
    python benchmarks/lidar_slam.py relocalise office:501 corridor:501              in maps of these, from another route

VENV is a virtual environment with kiss-icp. Drives are rendered once and kept in --cache. One thread; rendering is not
counted. Several runs of some worlds each may share a --json file, of which `table FILE` prints the whole.
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

import numpy as np  # noqa: E402
from lidar_odometry import drift, peer  # noqa: E402
from lidar_worlds import Drive, rendered  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.linalg import block_diag  # noqa: E402

from dataflow.messages import Odometry  # noqa: E402
from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.slam import LidarSlam  # noqa: E402

Array = NDArray[np.float64]

TRY = 20  # scans at 10 Hz within which a LiDAR is to be found
MOTIONS = ("deskewed", "as taken", "as taken, middle", "by azimuth")
WRONG = (0.2, 0.1)  # metres and radians beyond which a pose or a loop is wrong
COLUMNS = ("world", "motion", "odometry: ATE cm", "end cm", "SLAM: ATE cm", "end cm", "keyframes cm",
           "kiss-icp: ATE cm", "end cm", "NEES/6", "loops", "false", "keyframes", "views", "CPU ms: mean", "p95",
           "kiss-icp")  # fmt: skip


def seconds(world: str) -> int:
    """Returns how long a drive is: more than a round."""
    return 70 if world == "corridor" else 60


def scored(drive: Drive, params: dict[str, Any]) -> dict[str, float]:
    """Runs the SLAM, in which the odometry is, and scores both."""
    operator = LidarSlam(**params)
    operator.setup()
    odometry, poses = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    spent, squares = list[float](), list[float]()
    origin = invert(drive.truth[0])
    for cloud, T in zip(drive.clouds, drive.truth, strict=True):
        begin = time.process_time()
        messages = operator.process(cloud)
        spent.append(1e3 * (time.process_time() - begin))
        for port, way in (("odometry", odometry), ("pose", poses)):
            message = messages.get(port)
            way.append(message.matrix() if isinstance(message, Odometry) else np.full((4, 4), np.nan))
        pose = messages.get("pose")
        if isinstance(pose, Odometry) and pose.pose_covariance is not None and len(poses) > 1:
            off = se3.log(invert(origin @ T) @ poses[-1])
            R = block_diag(poses[-1][:3, :3], poses[-1][:3, :3])
            squares.append(float(off @ np.linalg.solve(R.T @ pose.pose_covariance @ R, off)) / 6)
    at = {cloud.stamp: T for cloud, T in zip(drive.clouds, drive.truth, strict=True)}
    graph = operator.state.mapper.graph
    nodes = list(graph.nodes.values())
    one, two = drift(np.array(odometry), drive.truth), drift(np.array(poses), drive.truth)
    return {
        "odometry ATE": one[0], "odometry end": one[1], "SLAM ATE": two[0], "SLAM end": two[1],
        "keyframes ATE": drift(np.array([n.T for n in nodes]), [at[n.stamp] for n in nodes])[0],
        "given": float(np.isfinite(np.array(poses)[:, 0, 0]).mean()),
        "NEES": float(np.median(squares)), "loops": graph.loops, "false loops": _false_loops(operator, at),
        "keyframes": len(nodes), "views": sum(n.view is not None for n in nodes),
        "ms mean": float(np.mean(spent)), "ms p95": float(np.percentile(spent, 95)),
    }  # fmt: skip


def _false_loops(operator: LidarSlam, at: dict[int, Array]) -> int:
    graph, wrong = operator.state.mapper.graph, 0
    for edge in graph.graph.edges:
        if edge.loop:
            true = invert(at[graph.nodes[edge.first].stamp]) @ at[graph.nodes[edge.last].stamp]
            wrong += _wrong(se3.log(invert(true) @ edge.T))
    return wrong


def _wrong(off: Array) -> bool:
    return bool(np.linalg.norm(off[:3]) > WRONG[0] or np.linalg.norm(off[3:]) > WRONG[1])


def worlds(
    named: list[tuple[str, int]],
    cache: Path,
    peers: Path | None,
    first: int,
    params: dict[str, Any],
    file: Path | None,
    motions: list[str],
) -> None:
    for world, seed in named:
        whole = rendered(cache, world, seed, seconds(world), 0.8).part(0, 10 * (first or seconds(world)))
        plain, by_azimuth = whole.without_times(), {"sweep": {"period": 1 / whole.sensor["rate"]}}
        drives = {"deskewed": whole, "as taken": plain, "as taken, middle": plain.at_middle(), "by azimuth": plain}
        for motion in motions:
            drive = drives[motion]
            name = f"{world} {seed}, {len(drive.clouds) / 10:.0f} s"
            more = by_azimuth if motion == "by azimuth" else {}
            row: dict[str, Any] = {"world": name, "motion": motion, **scored(drive, params | more)}
            if peers is not None and motion in ("deskewed", "as taken"):
                drive.sensor["far"] = params.get("far", drive.sensor["far"])
                other = peer("kiss", peers)(drive)
                row["kiss ATE"], row["kiss end"], _ = drift(other.poses, drive.truth)
                row["kiss ms"] = 1e3 * float(np.mean(other.cpu))
            print(_line(row), flush=True)
            if file is not None:
                known = json.loads(file.read_text()) if file.is_file() else []
                file.write_text(json.dumps([*known, row], indent=1) + "\n")


def _line(row: dict[str, Any]) -> str:
    two = ("odometry ATE", "odometry end", "SLAM ATE", "SLAM end", "keyframes ATE", "kiss ATE", "kiss end", "NEES")
    whole = ("loops", "false loops", "keyframes", "views", "ms mean", "ms p95", "kiss ms")
    cells = [row["world"], row["motion"], *(f"{row.get(k, np.nan):.2f}" for k in two)]
    return f"| {' | '.join([*cells, *(f'{row.get(k, np.nan):.0f}' for k in whole)])} |"


def table(rows: list[Any]) -> None:
    print(f"| {' | '.join(COLUMNS)} |\n| --- | --- |{' ---: |' * (len(COLUMNS) - 2)}")
    for row in rows:
        print(_line(row))
    for motion in MOTIONS:
        own = [row for row in rows if row["motion"] == motion]
        if not own:
            continue
        figures = [name for name in own[0] if name not in ("world", "motion")]
        for said, f in (("mean", np.mean), ("worst", np.max)):
            summary = {name: float(f([row[name] for row in own])) for name in figures}
            print(_line({"world": f"**{said}**", "motion": motion, **summary}))


def tries(map_file: Path, origin: Array | None, drive: Drive, every: int) -> Counter[str]:
    """Begins anew at every `every`th scan; `origin` is None where the map is of another place."""
    tally: Counter[str] = Counter()
    for begin in range(0, len(drive.clouds) - TRY, every):
        operator = LidarSlam(map_file=str(map_file))
        operator.setup()
        tally["tries"] += 1
        for k in range(begin, begin + TRY):
            start = time.process_time()
            pose = operator.process(drive.clouds[k]).get("pose")
            tally["longest, ms"] = max(tally["longest, ms"], round(1e3 * (time.process_time() - start)))
            if not isinstance(pose, Odometry):
                continue
            tally["found"] += 1
            tally["scans"] += k - begin
            if origin is None:
                tally["wrong"] += 1
            else:
                off = se3.log(invert(drive.truth[k]) @ origin @ pose.matrix())
                tally["wrong"] += _wrong(off)
                tally["within 5 cm"] += bool(np.linalg.norm(off[:3]) < 0.05)
            break
    return tally


def relocalise(named: list[tuple[str, int]], cache: Path, every: int) -> None:
    maps = {}
    for world, seed in named:
        drive, file = rendered(cache, world, seed, seconds(world), 0.8), cache / f"map_{world}_{seed}.npz"
        operator = LidarSlam(save=str(file))
        operator.setup()
        origin = drive.truth[0]
        for cloud in drive.clouds:
            operator.process(cloud)
        operator.finish()
        maps[world, seed] = file, origin
    print(
        "| world | tries | found | within 5 cm | scans until found, mean | wrong | tries in another's map | found "
        "| longest call, CPU s |"
    )
    print(f"| --- |{' ---: |' * 8}")
    for k, (world, seed) in enumerate(named):
        drive = rendered(cache, world, seed, 40, 0.5, "tour")
        own = tries(*maps[world, seed], drive, every)
        other = tries(maps[named[k - 1]][0], None, drive, 3 * every) if len(named) > 1 else Counter[str]()
        print(f"| {world} {seed} | {own['tries']} | {own['found']} | {own['within 5 cm']} "
              f"| {own['scans'] / max(1, own['found']):.1f} | {own['wrong']} | {other['tries']} | {other['found']} "
              f"| {max(own['longest, ms'], other['longest, ms']) / 1e3:.1f} |",
              flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["worlds", "relocalise", "table"])
    parser.add_argument("worlds", nargs="*", default=[], help="KIND:SEED, or the file of `table`")
    parser.add_argument("--peers", type=Path, help="virtual environment with kiss-icp")
    parser.add_argument("--cache", type=Path, default=Path("out") / "lidar_worlds", help="folder of rendered drives")
    parser.add_argument("--set", nargs="*", default=[], metavar="PARAM=VALUE", help="of LidarSlam")
    parser.add_argument("--every", type=int, default=20, help="scans from try to try")
    parser.add_argument("--seconds", type=int, default=0, help="of a drive, if not the whole")
    parser.add_argument("--json", type=Path, help="file to which all figures are added")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=["deskewed", "as taken"])
    arguments = parser.parse_args()
    if arguments.what == "table":
        table(json.loads(Path(arguments.worlds[0]).read_text()))
        return
    named = [(kind, int(seed)) for kind, _, seed in (name.partition(":") for name in arguments.worlds)]
    if arguments.what == "relocalise":
        relocalise(named, arguments.cache, arguments.every)
        return
    params = {name: float(value) for name, value in (pair.split("=") for pair in arguments.set)}
    worlds(named, arguments.cache, arguments.peers, arguments.seconds, params, arguments.json, arguments.motions)


if __name__ == "__main__":
    main()
