"""LidarOdometry in corridors with one box: how often its error along them is beyond what it claims.

    python benchmarks/lidar_corridors.py              # 40 drives of 1.3 s, and the same with a cover of 0.3 s
    python benchmarks/lidar_corridors.py --long 30    # drives of 7 s, past the box

Boxes, ways, speeds and noises are drawn at random; the walls are as in `tests/support/made_beams.py`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.append(str(REPOSITORY / "tests" / "support"))

from made_beams import CORRIDOR, beams, cast  # noqa: E402

from dataflow.messages import Diagnostics, Odometry, PointCloud  # noqa: E402
from dataflow.messages.geometry import invert  # noqa: E402
from operators.geometry import se3  # noqa: E402
from operators.odometry import LidarOdometry  # noqa: E402

Array = NDArray[np.float64]
COVERED = range(4, 7)
FAR = 0.2  # metres beyond which a place that is believed again is a wrong one


class Drive(NamedTuple):
    """One box in a corridor, and a straight way through that."""

    seed: int
    world: list[Any]
    start: Array
    speed: float
    noise: float


class Pose(NamedTuple):
    """Error along the corridor and what is claimed of it (m), and what the status gives."""

    error: float
    sigma: float
    text: str


def drives(count: int) -> Iterator[Drive]:
    rng = np.random.default_rng(5)
    for seed in range(count):
        x, width, depth = rng.uniform(1.5, 7), rng.uniform(0.3, 1), rng.uniform(0.3, 0.8)
        top, speed, noise = rng.choice([0.3, 0.8, 1.2, 2.0]), rng.choice([0.5, 1.0, 1.5]), rng.choice([0.01, 0.02])
        aside, yaw, side = rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1), rng.choice([-1, 1])
        face = side * (1 - depth)
        across, ahead = (min(side, face), max(side, face)), (x, x + width)
        box = [(0, x, across, (-1, top)), (0, x + width, across, (-1, top)), (1, face, ahead, (-1, top))]
        start = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
        start[1, 3] = aside
        yield Drive(seed, [*CORRIDOR, *box, (2, top, ahead, across)], start, float(speed), float(noise))


def scan(drive: Drive, T: Array, k: int) -> PointCloud:
    rays = beams()
    distance = cast(drive.world, np.tile(T[:3, 3], (len(rays), 1)), rays @ T[:3, :3].T)
    distance = distance + np.random.default_rng([drive.seed, k]).normal(0, drive.noise, len(rays))
    kept = np.isfinite(distance)
    points = (rays[kept] * distance[kept, None]).astype(np.float32)
    return PointCloud(stamp=k * 100_000_000, frame="lidar", points=points)


def driven(drive: Drive, scans: int, covered: bool) -> Iterator[Pose]:
    """Yields the poses after the first; where the LiDAR is covered, it is 0.9 m farther on when it sees again."""

    def at(k: int) -> Array:
        T = drive.start.copy()
        T[0, 3] += drive.speed * 0.1 * k + (0.9 if covered and k >= COVERED.start else 0.0)
        return T

    operator = LidarOdometry(patience=0.15) if covered else LidarOdometry()
    operator.setup()
    ahead = at(0)[:3, :3].T[:, 0]
    for k in range(scans):
        cloud = scan(drive, at(k), k)
        hidden = covered and k in COVERED
        made = operator.process(cloud.replace(points=np.zeros((0, 3), np.float32)) if hidden else cloud)
        odometry, status = made.get("odometry"), made["status"]
        assert isinstance(status, Diagnostics)
        if k == 0 or hidden or not isinstance(odometry, Odometry) or odometry.pose_covariance is None:
            continue
        off = odometry.matrix()[:3, 3] - (invert(at(0)) @ at(k))[:3, 3]
        sigma = np.sqrt(ahead @ odometry.pose_covariance[:3, :3] @ ahead)
        yield Pose(abs(float(ahead @ off)), float(sigma), status.messages[0])


def counted(name: str, found: Callable[[Drive], Iterator[Pose]], chosen: list[Drive]) -> None:
    poses = [pose for drive in chosen for pose in found(drive)]
    false = sum(pose.error > 3 * pose.sigma for pose in poses)
    untold = sum("nothing" in pose.text for pose in poses)
    again = [pose for pose in poses if pose.text.startswith("relocalised")]
    wrong = sum(pose.error > FAR for pose in again)
    print(f"| {name} | {len(chosen)} | {false} of {len(poses)} | {untold} | {wrong} of {len(again)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--long", type=int, help="drives of 7 s in place of those, of others than the first hundred")
    options = parser.parse_args()
    print("| drives | number | beyond 3 sigma | direction named untold | relocalised at a wrong place |")
    print("| --- | ---: | ---: | ---: | ---: |")
    if options.long is not None:
        counted("7 s", lambda drive: driven(drive, 70, False), list(drives(100 + options.long))[100:])
        return
    counted("1.3 s", lambda drive: driven(drive, 14, False), list(drives(options.drives)))
    counted("covered for 0.3 s", lambda drive: driven(drive, 14, True), list(drives(options.drives)))


if __name__ == "__main__":
    main()
