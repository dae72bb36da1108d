"""LiDAR odometry at low rates on made roads: ours and kiss-icp, where a car moves metres between scans.

python benchmarks/lidar_road.py [--peers ENVIRONMENT] [--roads 1 2 3] [--every 1 2 3 5 7 10] [--speed 20] [--still]

A road is a street of boxes by its seed (facades, gaps between them, parked cars, poles) with curves; the car brakes and
goes up to 20 m/s. The LiDAR has 32 rings of 720 points at 10 Hz and moves during its sweep; of its scans every second,
third ... is taken. Figures are of steps between scans that are taken, against the truth: a step is wrong that is more
than 0.5 m or 1 degree off. *Of these told* are wrong steps of a scan whose state is not `tracking`; *not tracking* are
the scans of such a state. `--speed` is the car's all along; with `--still` it stands during each sweep, so nothing has
to be deskewed (kiss-icp deskews by the motion between scans). ENVIRONMENT is a virtual environment with the peers.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from lidar_odometry import peer  # noqa: E402
from lidar_worlds import Drive  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages import Diagnostics, Odometry, PointCloud  # noqa: E402
from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry import LidarOdometry  # noqa: E402

Array = NDArray[np.float64]
SENSOR = {"near": 1.0, "far": 80.0, "rate": 10.0, "rows": 32, "columns": 720, "indoors": False}
RINGS, COLUMNS, PERIOD = 32, 720, 0.1
WRONG = (0.5, 1.0)  # metres, degrees


def ground_track(seed: int, seconds: float, steady: float | None = None) -> Array:
    """Returns (x, y, heading, speed) of the car every 10 ms: it speeds up, brakes, and turns where it is slow."""
    rng = np.random.default_rng(seed)
    x = y = heading = 0.0
    speed, goal, turn, rows = steady or 8.0, 15.0, 0.0, []
    for k in range(int(seconds * 100) + 20):
        if k % 250 == 0:
            drawn = float(rng.uniform(6, 20))
            goal = steady or drawn
            turn = float(rng.choice([0, 1, -1])) * float(rng.uniform(0.1, 0.5))
        speed += float(np.clip(goal - speed, -0.04, 0.025))  # 4 and 2.5 m/s^2
        rate = turn * min(1.0, 7.0 / speed) * np.sin(np.pi * (k % 250) / 250)
        heading += 0.01 * rate
        x, y = x + 0.01 * speed * np.cos(heading), y + 0.01 * speed * np.sin(heading)
        rows.append((x, y, heading, speed))
    return np.array(rows)


def boxes_beside(track: Array, seed: int) -> Array:
    """Returns boxes (B, 7) along both sides: centre x, y, half length, half depth, height, cosine and sine."""
    rng = np.random.default_rng(seed + 1000)
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(track[:, :2], axis=0).T))])
    boxes = []
    for side in (-1, 1):
        for kind in ("facade", "car", "pole"):
            at = -20.0
            while at < along[-1] + 60:
                gap, half, depth, height, off = {
                    "facade": (rng.uniform(0, 12), rng.uniform(3, 12), 5.0, rng.uniform(4, 12), rng.uniform(14, 20)),
                    "car": (rng.exponential(12), 2.2, 0.9, 1.5, 5.5),
                    "pole": (rng.uniform(15, 35), 0.12, 0.12, 7.0, 7.5),
                }[kind]
                at += gap + half
                here = track[int(np.clip(np.searchsorted(along, at), 0, len(track) - 1))]
                c, s = np.cos(here[2]), np.sin(here[2])
                beyond = at - float(np.clip(at, 0, along[-1]))
                place = here[:2] + [beyond * c, beyond * s] + side * off * np.array([-s, c])
                if np.min(np.hypot(*(track[::20, :2] - place).T)) > off - 1.5:  # never on the road of another stretch
                    boxes.append((*place, half, depth, height, c, s))
                at += half
    return np.array(boxes)


def scan(
    track: Array, boxes: Array, stamp: float, rng: np.random.Generator, still: bool
) -> tuple[NDArray[np.float32], Array]:
    """Returns the points (N, 3) of a sweep that ends at a time, s, in the frames of their moments, and offsets (N,)."""
    offsets = np.repeat(np.linspace(-PERIOD, 0, COLUMNS, endpoint=False), RINGS)
    azimuth = np.repeat(np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False), RINGS)
    elevation = np.tile(np.radians(np.linspace(-25, 10, RINGS)), COLUMNS)
    at = (stamp + (0.0 * offsets if still else offsets)) * 100 + 10
    x, y, heading = (
        np.interp(at, np.arange(len(track)), np.unwrap(track[:, i]) if i == 2 else track[:, i]) for i in range(3)
    )
    flat = np.cos(elevation)
    directions = np.column_stack(
        [flat * np.cos(azimuth + heading), flat * np.sin(azimuth + heading), np.sin(elevation)]
    )
    origins = np.column_stack([x, y, np.full(len(x), 1.8)])
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], np.inf)
        for cx, cy, half, depth, height, c, s in boxes[np.hypot(*(boxes[:, :2] - origins[0, :2]).T) < 90]:
            across = np.column_stack([[c, -s], [s, c]])
            o = np.column_stack([(origins[:, :2] - [cx, cy]) @ across, origins[:, 2] - height / 2])
            d = np.column_stack([directions[:, :2] @ across, directions[:, 2]])
            reach = np.array([half, depth, height / 2])
            a, b = (-reach - o) / d, (reach - o) / d
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            distance = np.where((near < far) & (near > 0) & (near < distance), near, distance)
    seen = distance < 80
    distance = distance[seen] + rng.normal(0, 0.02, int(seen.sum()))
    local = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])[seen]
    return (local * distance[:, None]).astype(np.float32), offsets[seen]


def road(seed: int, seconds: float, steady: float | None = None, still: bool = False) -> Drive:
    """Returns the scans of a drive, with the true pose of each; without times where the car stands during a sweep."""
    track = ground_track(seed, seconds, steady)
    boxes, rng = boxes_beside(track, seed), np.random.default_rng(seed + 2000)
    clouds, truth = [], []
    for k in range(1, int(seconds / PERIOD)):
        points, offsets = scan(track, boxes, k * PERIOD, rng, still)
        stamp, times = round(k * PERIOD * 1e9), None if still else offsets.astype(np.float32)
        clouds.append(PointCloud(stamp=stamp, frame="lidar", points=points, time_offsets=times))
        x, y, heading, _ = track[round(k * PERIOD * 100) + 10]
        T = se3.exp(np.array([0, 0, 0, 0, 0, heading]))
        T[:3, 3] = x, y, 1.8
        truth.append(T)
    return Drive(clouds, truth, SENSOR)


def every(drive: Drive, step: int) -> Drive:
    return Drive(drive.clouds[::step], drive.truth[::step], drive.sensor | {"rate": 10.0 / step})


def ours(drive: Drive) -> tuple[Array, list[str]]:
    """Returns the poses, NaN where none is given, and the states."""
    operator = LidarOdometry(near=drive.sensor["near"])
    operator.setup()
    poses, states = [], []
    for cloud in drive.clouds:
        messages = operator.process(cloud)
        odometry, status = messages.get("odometry"), messages["status"]
        assert isinstance(status, Diagnostics)
        states.append(status.values[0])
        poses.append(odometry.matrix() if isinstance(odometry, Odometry) else np.full((4, 4), np.nan))
    return np.array(poses), states


def errors(poses: Array, truth: list[Array]) -> Array:
    """Returns the error (N - 1, 2) of each step, metres and degrees; NaN where a pose is not given."""
    rows = []
    for k in range(1, len(truth)):
        off = (
            se3.log(invert(invert(truth[k - 1]) @ truth[k]) @ invert(poses[k - 1]) @ poses[k])
            if np.isfinite(poses[k - 1 : k + 1]).all()
            else np.full(6, np.nan)
        )
        rows.append((np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))))
    return np.array(rows)


def row(name: str, step: int, poses: Array, truth: list[Array], states: list[str] | None) -> str:
    off = errors(poses, truth)
    given = np.isfinite(off[:, 0])
    wrong = given & ((off[:, 0] > WRONG[0]) | (off[:, 1] > WRONG[1]))
    told = "" if states is None else str(sum(w and states[k + 1] != "tracking" for k, w in enumerate(wrong)))
    lost = "" if states is None else str(sum(state != "tracking" for state in states))
    metres, degrees = off[given].T
    return (f"| {name} | {step} | {len(truth)} | {100 * np.median(metres):.1f} | {100 * metres.max():.0f} "
            f"| {np.median(degrees):.2f} | {wrong.sum()} | {told} | {lost} |")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, help="virtual environment with kiss-icp")
    parser.add_argument("--roads", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--every", type=int, nargs="+", default=[1, 2, 3, 5, 7, 10])
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--speed", type=float, help="m/s, all along (default: 6 to 20)")
    parser.add_argument("--still", action="store_true", help="the car stands during each sweep")
    parser.add_argument("--names", nargs="+", default=["kiss"], help="which peers")
    options = parser.parse_args()
    print(
        "| road, odometry | every | scans | step, cm: median | worst | degrees | wrong | of these told | not tracking |"
    )
    print("| --- " * 9 + "|")
    for seed in options.roads:
        whole = road(seed, options.seconds, options.speed, options.still)
        for step in options.every:
            drive = every(whole, step)
            poses, states = ours(drive)
            print(row(f"{seed}, ours", step, poses, drive.truth, states), flush=True)
            for name in options.names if options.peers else []:
                found = peer(name, options.peers)(drive)
                print(row(f"{seed}, {name}", step, found.poses, drive.truth, None), flush=True)


if __name__ == "__main__":
    main()
