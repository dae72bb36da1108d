"""Drift and honesty of wheel odometry in simulated worlds; the simulated controller's own odometry beside it.

python benchmarks/wheel_odometry.py --seeds 21 22 23 24
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry
from dataflow.messages.geometry import invert, yaw_of
from dataflow.testing import play
from operators.odometry import WheelOdometry
from operators.simulator import SimulatedRobot

Array = NDArray[np.float64]
WORLDS = ("office", "corridor", "table_top")


def planar(message: Odometry, T_start: Array) -> Array:
    """x, y and yaw from a start."""
    T = invert(T_start) @ message.matrix()
    return np.array([T[0, 3], T[1, 3], float(yaw_of(Odometry.from_matrix(
        T, stamp=0, frame="a", child_frame="b").orientation))])  # fmt: skip


def drives(world: str, seed: int, seconds: int) -> tuple[list[Any], list[Odometry], list[Odometry]]:
    """Wheel ticks, the controller's odometry and the truth, at equal stamps."""
    robot = SimulatedRobot(
        world=world, seed=seed, duration=seconds * 10**9, color_camera={"rate": 0}, depth_camera={"rate": 0},
        wheels={"rate": 20}, truth={"poses": 20, "relations": 0, "activities": 0},
    )  # fmt: skip
    played = play(robot)
    return played["wheel_ticks"], played["wheel_odometry"], played["true_base"]  # type: ignore[return-value]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22, 23, 24], help="of the simulated worlds")
    parser.add_argument("--seconds", type=int, default=20, help="of each drive")
    arguments = parser.parse_args()
    print("| world | method | way m | end error m | worst | end error degrees | NEES / 3 at the end | worst |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    spent, readings, ratios = 0.0, 0, dict[str, list[float]]()
    for world in WORLDS:
        rows: dict[str, list[list[float]]] = {}
        for seed in arguments.seeds:
            ticks, theirs, truth = drives(world, seed, arguments.seconds)
            before = time.process_time()
            ours: Any = play(WheelOdometry(track=0.4), {"wheels": ticks}, paranoid=False)["odometry"]
            spent += time.process_time() - before
            readings += len(ticks)
            places = np.array([t.position[:2] for t in truth])
            way = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
            for name, found in (("controller", theirs), ("WheelOdometry", ours)):
                error = planar(found[-1], found[0].matrix()) - planar(truth[-1], truth[0].matrix())
                error[2] = math.remainder(error[2], 2 * math.pi)
                covariance: Any = found[-1].pose_covariance
                C = covariance[np.ix_([0, 1, 5], [0, 1, 5])]
                nees = float(error @ np.linalg.solve(C, error)) / 3
                rows.setdefault(name, []).append([way, math.hypot(*error[:2]), math.degrees(abs(error[2])), nees])
        for name, row in rows.items():
            way, end, degrees, nees = np.mean(row, axis=0)
            worst = np.max(row, axis=0)
            ratios.setdefault(name, []).extend(r[3] for r in row)
            print(
                f"| {world} | {name} | {way:.1f} | {end:.3f} | {worst[1]:.3f} | {degrees:.2f} | {nees:.2f} "
                f"| {worst[3]:.2f} |"
            )
    for name, values in ratios.items():
        print(f"\n{name}: NEES / 3 median {np.median(values):.2f}, above 2.60 (the 95 % bound) "
              f"{np.mean(np.array(values) > 2.6):.2f} of {len(values)} drives")  # fmt: skip
    print(f"\nCPU of a reading: {1e6 * spent / readings:.0f} us, the machinery of a firing included")


if __name__ == "__main__":
    main()
