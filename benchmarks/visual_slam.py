"""RGB-D SLAM: accuracy and time beside the odometry in front of it, and being found in a saved map.

    python benchmarks/visual_slam.py recorded                               7-Scenes, as benchmarks/visual_odometry.py
    python benchmarks/visual_slam.py worlds office:501 table_top:501        simulated worlds, kind and seed
    python benchmarks/visual_slam.py relocalise office:501 table_top:501    in maps of these, from elsewhere
    python benchmarks/visual_slam.py halves                                 7-Scenes: one half in the map of the other

Simulated drives are rendered once and kept in --cache. One thread; rendering and decoding are not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from odometry_worlds import Drive  # noqa: E402

from dataflow.messages.geometry import invert  # noqa: E402
from operators.evaluation.trajectory import align  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry.rgbd.camera import RgbdCamera  # noqa: E402
from operators.odometry.rgbd.settings import RgbdOdometryConfig  # noqa: E402
from operators.odometry.rgbd.tracker import RgbdOdometry  # noqa: E402
from operators.slam.keyframe_graph import Node  # noqa: E402
from operators.slam.visual.graph import GraphSettings  # noqa: E402
from operators.slam.visual.map_file import read_visual_map, write_visual_map  # noqa: E402
from operators.slam.visual.mapper import RgbdSlam, SlamResult, SlamState  # noqa: E402
from operators.slam.visual.view import View  # noqa: E402

Array = NDArray[np.float64]

MOUNTS: dict[str, Any] = {  # the camera of the drive that makes a map is the world's own, at 0.8 m/s; these come later
    "higher": {"shift": (0.0, 0.0, 0.25, 0.0, 0.15, 0.0), "speed": 0.6},
    "turned": {"shift": (0.1, 0.15, -0.15, 0.0, 0.0, 0.35), "speed": 0.5},
}
TRY = 20  # frames at 10 Hz within which a camera is to be found
WRONG = (0.2, 0.1)  # metres and radians beyond which a pose is wrong


def rendered(cache: Path, world: str, seed: int, seconds: int, mount: str | None) -> Drive:
    file = cache / f"{world}_{seed}_{seconds}s_{mount or 'own'}.npz"
    if not file.is_file():
        _render(file, world, seed, seconds, mount)
    d = np.load(file)
    return Drive(d["image"], d["depth"], d["truth"], d["stamps"], RgbdCamera(d["K_color"], d["K_depth"]))


def _render(file: Path, world: str, seed: int, seconds: int, mount: str | None) -> None:
    from operators.simulator import SimulatedRobot
    from operators.simulator.worlds.make import make_world

    color: dict[str, Any] = {"rate": 10}
    speed = 0.8 if mount is None else float(MOUNTS[mount]["speed"])
    if mount is not None:
        own = np.array(make_world(world, seed, speed=speed, hold=0.0, movers=True).camera_mount)
        color["mount"] = tuple(own + MOUNTS[mount]["shift"])
    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{seconds}s",
        speed=speed,
        color_camera=color,
        depth_camera={"rate": 10, "noise": 0.0012, "grain": 4, "quantum": 0.0025},
        truth={"poses": 10, "boxes": False, "relations": 0, "activities": 0},
    )
    robot.setup()
    static: dict[str, Any] = dict(robot.static_outputs())
    messages: list[dict[str, Any]] = [dict(m) for m in robot.stream()]
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        file,
        image=np.array([m["image"].data for m in messages]),
        depth=np.array([m["depth"].data for m in messages]),
        truth=np.array([m["ground_truth"].matrix() for m in messages]),
        stamps=np.array([m["image"].stamp for m in messages], np.int64),
        K_color=static["image_info"].K,
        K_depth=static["depth_info"].K,
    )


def recorded(folder: Path) -> Drive:
    images, depths, truth = [], [], []
    for file in sorted(folder.glob("*.color.jpg")):
        stem = file.name.split(".")[0]
        raw = np.asarray(cv2.imread(str(folder / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED))
        depths.append(np.where(raw == 65535, 0, raw).astype(np.float32) / np.float32(1000))
        images.append(np.asarray(cv2.imread(str(file), cv2.IMREAD_COLOR_RGB), np.uint8))
        truth.append(se3.orthonormalised(np.loadtxt(folder / f"{stem}.pose.txt")))
    if not images:
        raise SystemExit(f"no frame-NNNNNN.color.jpg in {folder}: give a 7-Scenes folder with --data")
    K_depth = np.loadtxt(folder / "camera-intrinsics.txt")
    K_color = K_depth.copy()
    K_color[0, 0] = K_color[1, 1] = 525.0
    stamps = np.arange(len(images), dtype=np.int64) * (10**9 // 30)
    return Drive(np.array(images), np.array(depths), np.array(truth), stamps, RgbdCamera(K_color, K_depth))


def slam_of(camera: RgbdCamera, config: RgbdOdometryConfig) -> RgbdSlam:
    return RgbdSlam(camera, config, SlamState.begun(config, GraphSettings()))


def ate(estimate: Array, truth: Array) -> float:
    """RMSE in centimetres after SE(3) alignment."""
    R, t, _ = align(estimate[:, :3, 3], truth[:, :3, 3], scaled=False)
    return float(100 * np.sqrt(((estimate[:, :3, 3] @ R.T + t - truth[:, :3, 3]) ** 2).sum(axis=1).mean()))


def from_start(estimate: Array, truth: Array) -> Array:
    """Returns the errors (N, 6), metres and radians, where the first poses coincide."""
    T = truth[0] @ invert(estimate[0])
    return np.array([se3.log(invert(b) @ T @ a) for a, b in zip(estimate, truth, strict=True)])


def drift(estimate: Array, truth: Array) -> float:
    """Largest error in centimetres over the last tenth, where the first poses coincide."""
    errors = from_start(estimate, truth)
    return float(100 * np.linalg.norm(errors[-len(errors) // 10 :, :3], axis=1).max())


def compare(drive: Drive) -> dict[str, Any]:
    """Runs the odometry and the SLAM in turns, frame by frame."""
    config = RgbdOdometryConfig()
    plain, slam = RgbdOdometry(drive.camera, config), slam_of(drive.camera, config)
    odometry, results = [], list[SlamResult]()
    spent: dict[str, list[float]] = {"odometry": [], "slam": []}
    for image, depth, stamp in zip(drive.image, drive.depth, drive.stamps.tolist(), strict=True):
        t = time.process_time()
        odometry.append(plain.track(image, depth, stamp).T_world_camera)
        spent["odometry"].append(1e3 * (time.process_time() - t))
        t = time.process_time()
        results.append(slam.track(image, depth, stamp))
        spent["slam"].append(1e3 * (time.process_time() - t))
    poses = np.array([r.T_map_odom @ r.odometry.T_world_camera for r in results if r.T_map_odom is not None])
    at = {int(stamp): T for stamp, T in zip(drive.stamps, drive.truth, strict=True)}
    nodes = list(slam.graph.nodes.values())
    errors = from_start(poses, drive.truth)
    square = np.array(
        [e @ np.linalg.solve(r.covariance + 1e-12 * np.eye(6), e) for e, r in zip(errors, results, strict=True)]
    )
    return {
        "ate_odometry": ate(np.array(odometry), drive.truth),
        "ate_slam": ate(poses, drive.truth),
        "ate_keyframes": ate(np.array([n.T for n in nodes]), np.array([at[n.stamp] for n in nodes])),
        "end_odometry": drift(np.array(odometry), drive.truth),
        "end_slam": drift(poses, drive.truth),
        "nees": float(np.median(square[1:]) / 6),
        "keyframes": len(nodes),
        "views": sum(n.view is not None for n in nodes),
        "loops": slam.graph.loops,
        "frames": dict(Counter(str(r.place) for r in results)),
        "refused": dict(Counter(reason for r in results for reason in r.added.refused)),
        "ms_odometry": float(np.mean(spent["odometry"])),
        "ms_slam": float(np.mean(spent["slam"])),
        "p50_slam": float(np.percentile(spent["slam"], 50)),
        "p99_slam": float(np.percentile(spent["slam"], 99)),
        "worst_slam": float(np.max(spent["slam"])),
        "false loops": _false_loops(slam, at),
    }


def _false_loops(slam: RgbdSlam, at: dict[int, Array]) -> int:
    wrong = 0
    for edge in slam.graph.graph.edges:
        if edge.loop:
            true = invert(at[slam.graph.nodes[edge.first].stamp]) @ at[slam.graph.nodes[edge.last].stamp]
            off = se3.log(invert(true) @ edge.T)
            wrong += bool(np.linalg.norm(off[:3]) > WRONG[0] or np.linalg.norm(off[3:]) > WRONG[1])
    return wrong


COLUMNS = ("ate_odometry", "ate_slam", "ate_keyframes", "end_odometry", "end_slam", "nees", "keyframes", "views",
           "loops", "false loops", "ms_odometry", "ms_slam", "p50_slam", "p99_slam", "worst_slam")  # fmt: skip


def show(name: str, row: dict[str, Any]) -> None:
    cells = [f"{row[c]:.2f}" if isinstance(row[c], float) else str(row[c]) for c in COLUMNS]
    print(f"| {name} | {' | '.join(cells)} |  {row['frames']} {row['refused']}", flush=True)


def saved_map(drive: Drive, file: Path) -> tuple[list[Node[View]], Array]:
    """Returns a map of a drive, saved and loaded, and the true pose (4, 4) of its origin."""
    slam = slam_of(drive.camera, RgbdOdometryConfig())
    for image, depth, stamp in zip(drive.image, drive.depth, drive.stamps.tolist(), strict=True):
        slam.track(image, depth, stamp)
    write_visual_map(slam.graph, file)
    return read_visual_map(file), drive.truth[0]


def tries(known: list[Node[View]], origin: Array | None, drive: Drive, every: int) -> Counter[str]:
    """Begins anew at every `every`th frame; `origin` is None where the map is of another place."""
    tally: Counter[str] = Counter()
    for begin in range(0, len(drive.stamps) - TRY, every):
        slam = slam_of(drive.camera, RgbdOdometryConfig())
        slam.graph.begin_in(known)
        tally["tries"] += 1
        for k in range(begin, begin + TRY):
            result = slam.track(drive.image[k], drive.depth[k], int(drive.stamps[k]))
            if result.T_map_odom is None:
                continue
            tally["found"] += 1
            tally["frames"] += k - begin
            if origin is None:
                tally["wrong"] += 1
            else:
                off = se3.log(invert(drive.truth[k]) @ origin @ result.T_map_odom @ result.odometry.T_world_camera)
                far, turned = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
                tally["wrong"] += far > WRONG[0] or turned > WRONG[1]
                tally["within 5 cm"] += far < 0.05
                tally["worst mm"] = max(tally["worst mm"], round(1e3 * far))
            break
    return tally


def relocalise(worlds: list[tuple[str, int]], cache: Path, seconds: int, every: int) -> None:
    maps = {}
    for world, seed in worlds:
        drive = rendered(cache, world, seed, seconds, None)
        maps[world, seed] = saved_map(drive, cache / f"map_{world}_{seed}_saved.npz")
    for world, seed in worlds:
        for mount in MOUNTS:
            drive = rendered(cache, world, seed, 30, mount)
            known, origin = maps[world, seed]
            print(f"{world} {seed}, {mount}: {dict(tries(known, origin, drive, every))}", flush=True)
            for other, (elsewhere, _) in maps.items():
                if other != (world, seed):
                    print(f"   in the map of {other}: {dict(tries(elsewhere, None, drive, 3 * every))}", flush=True)


def part(drive: Drive, first: int, last: int) -> Drive:
    at = slice(first, last)
    return Drive(drive.image[at], drive.depth[at], drive.truth[at], drive.stamps[at], drive.camera)


def halves(drive: Drive, cache: Path, every: int) -> None:
    """Looks for the frames of each half in the map of the other; prints their distance from the map's nearest view."""
    middle = len(drive.stamps) // 2
    parts = {"first": part(drive, 0, middle), "second": part(drive, middle, len(drive.stamps))}
    for mapped, tried in (("first", "second"), ("second", "first")):
        known, origin = saved_map(parts[mapped], cache / f"map_7scenes_{mapped}.npz")
        tally = tries(known, origin, parts[tried], every)
        apart = []
        for T in parts[tried].truth[:-TRY:every]:
            offs = np.array([se3.log(invert(origin @ node.T) @ T) for node in known])
            nearest = np.argmin(np.linalg.norm(offs[:, :3], axis=1) / 2.0 + np.linalg.norm(offs[:, 3:], axis=1))
            apart.append(offs[nearest])
        away = np.array(apart)
        metres, turn = np.linalg.norm(away[:, :3], axis=1), np.degrees(np.linalg.norm(away[:, 3:], axis=1))
        print(
            f"{tried} half in the map of the {mapped}, {len(known)} views: {dict(tally)}; nearest view "
            f"{np.median(metres):.2f} m and {np.median(turn):.0f} degrees away, "
            f"at most {metres.max():.2f} and {turn.max():.0f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "rgbd_7scenes"
    parser.add_argument("what", choices=["recorded", "worlds", "relocalise", "halves"])
    parser.add_argument("worlds", nargs="*", default=[], help="KIND:SEED")
    parser.add_argument("--data", type=Path, default=data, help="a 7-Scenes folder (default: the project's data)")
    parser.add_argument("--cache", type=Path, default=Path("out") / "visual_slam", help="folder of rendered drives")
    parser.add_argument("--seconds", type=int, default=60, help="of a drive")
    parser.add_argument("--every", type=int, default=15, help="frames from try to try")
    parser.add_argument("--json", type=Path, help="file for all figures")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    worlds = [(kind, int(seed)) for kind, _, seed in (name.partition(":") for name in arguments.worlds)]
    if arguments.what == "relocalise":
        relocalise(worlds, arguments.cache, arguments.seconds, arguments.every)
        return
    if arguments.what == "halves":
        halves(recorded(arguments.data), arguments.cache, arguments.every)
        return
    rows = {}
    print(f"| drive | {' | '.join(COLUMNS)} |\n| --- |{' ---: |' * len(COLUMNS)}")
    if arguments.what == "recorded":
        rows["7-Scenes"] = compare(recorded(arguments.data))
        show("7-Scenes", rows["7-Scenes"])
    for world, seed in worlds:
        name = f"{world} {seed}"
        rows[name] = compare(rendered(arguments.cache, world, seed, arguments.seconds, None))
        show(name, rows[name])
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
