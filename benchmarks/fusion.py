"""Error-state fusion on EuRoC's inertial data and on the simulator: accuracy, outages, consistency.

    python benchmarks/fusion.py euroc DATA/euroc_v1_01_imu --seeds 0-20
    python benchmarks/fusion.py simulator --seeds 0-50

EuRoC: positions at 20 Hz are the truth with 2 cm of noise an axis and 10 % outliers of 0.5 m an axis; the last 3 s of
every 12 s have none. The RMSE leaves out the first 0.2 s after an outage; the heading is not given. Simulator: inertial
samples, positions of 2 cm horizontally, 4 cm vertically at 20 Hz, none in the last 3 s of every 12 s; NEES of position
and orientation at the end of each outage and 2 s after.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np

PERIOD, OUTAGE = 12.0, 3.0


def fed(operator, samples, fixes):  # type: ignore[no-untyped-def]
    """Gives an operator its messages in the order of their stamps; yields its odometry."""
    from dataflow.operator import Context

    for message in sorted([*samples, *fixes], key=lambda m: (m.stamp, m.SCHEMA)):
        name = "ns/sensor/imu" if message.SCHEMA == samples[0].SCHEMA else "ns/sensor/fix"
        given = operator.process({name: message}, Context(message.stamp))
        if given is not None and given["odometry"] is not None:
            yield given["odometry"]


@cache
def recorded(folder: Path):  # type: ignore[no-untyped-def]
    """The inertial samples and the true poses."""
    from operators.sources import EurocImu

    source = EurocImu(path=str(folder))
    source.setup()
    steps = list(source.stream())
    return [m["imu"] for m in steps if "imu" in m], [m["ground_truth"] for m in steps if "ground_truth" in m]


def euroc(folder: Path, seed: int) -> tuple[float, list[float], str]:
    """RMSE outside of outages (m), the error at every outage's end, and what became of the fixes."""
    from dataflow.messages import Pose
    from operators.fusion import EkfFusion
    from operators.fusion.sensors import SensorSettings

    samples, truth = recorded(folder)
    stamps = np.array([t.stamp for t in truth])
    rng = np.random.default_rng(seed)
    fixes = []
    for pose in truth[::10]:
        place = pose.position + rng.normal(0, 0.02, 3)
        if rng.random() < 0.1:
            place = place + rng.normal(0, 0.5, 3)
        if (pose.stamp - stamps[0]) * 1e-9 % PERIOD < PERIOD - OUTAGE:
            fixes.append(
                Pose(stamp=pose.stamp, frame="world", child_frame="imu", position=place, orientation=[0, 0, 0, 1])
            )
    operator = EkfFusion(
        base_frame="imu",
        gravity=9.81,
        gyro_noise=5e-4,
        accel_noise=1.6e-2,
        gyro_walk=1e-4,
        accel_walk=3e-4,
        sensors={"sensor/fix": SensorSettings(use="position", sigma=0.02)},
    )
    operator.setup()
    errors, ends, last, was_out = [], [], 0.0, False
    for estimate in fed(operator, samples, fixes):
        k = int(np.searchsorted(stamps, estimate.stamp - 2_500_000))
        if k == len(stamps) or abs(int(stamps[k]) - estimate.stamp) > 2_500_000:
            continue
        error = float(np.linalg.norm(estimate.position - truth[k].position))
        since = (estimate.stamp - int(stamps[0])) * 1e-9
        out = since % PERIOD >= PERIOD - OUTAGE
        if was_out and not out:
            ends.append(last)
        if not out and (since % PERIOD >= 0.2 or since < PERIOD) and since > 3:
            errors.append(error)
        last, was_out = error, out
    health = operator._filter.health["sensor/fix"]  # type: ignore[union-attr]
    text = f"used {health.used}, refused {health.refused}, unconfirmed {health.unconfirmed}, made room {health.widened}"
    return math.sqrt(float(np.mean(np.square(errors)))), ends, text


def simulator(seed: int) -> tuple[list[float], list[list[float]], list[float]]:
    """Errors at the outages' ends (m); NEES of position and orientation there and 2 s after; errors between outages."""
    from dataflow.messages.geometry import quaternion_to_matrix
    from operators.fusion import EkfFusion
    from operators.fusion.error_state import log_rotation
    from operators.sources import SimulatedRobot

    rng = np.random.default_rng([seed, 7])
    seconds = 36
    outages = [(k + PERIOD - OUTAGE, k + PERIOD) for k in np.arange(0, seconds, PERIOD)]
    robot = SimulatedRobot(
        world=("office", "corridor", "table_top")[seed % 3],
        seed=seed,
        duration=f"{seconds}s",
        color_camera={"rate": 0},
        depth_camera={"rate": 0},
        lidar={"rate": 0},
        inertial={
            "rate": 100,
            "gyro_bias": tuple(rng.normal(0, 0.005, 3)),
            "accel_bias": tuple(rng.normal(0, 0.05, 3)),
        },
        gnss={"rate": 20, "noise": 0.02, "drift": 0.0, "outages": outages},
        truth={"poses": 100, "relations": 0, "activities": 0, "boxes": False},
    )
    robot.setup()
    extrinsics = robot.static_outputs()["extrinsics"]
    samples, fixes, truth = [], [], {}
    for step in robot.stream():
        samples += [step["imu"]] if "imu" in step else []
        fixes += [step["fix"]] if "fix" in step else []
        if "true_base" in step:
            truth[step["true_base"].stamp] = step["true_base"]
    robot.close()
    q = truth[500_000_000].orientation
    heading = float(2 * np.arctan2(q[2], q[3]))
    operator = EkfFusion(
        origin=(48.1374, 11.5755, 520.0),
        gyro_bias=0.005,
        accel_bias=0.05,
        heading=heading + 0.05 * rng.standard_normal(),
        heading_sigma=0.05,
        rest=0.5,
        patience=0.5,
    )
    operator.setup()
    process = operator.process
    operator.process = lambda m, c: process(m, c, extrinsics)  # type: ignore[method-assign, assignment]
    ends, nees, errors = [], [], []
    for estimate in fed(operator, samples, fixes):
        true = truth.get(estimate.stamp)
        if true is None:
            continue
        since = estimate.stamp * 1e-9
        off = true.position - estimate.position
        phase = since % PERIOD
        at_end = abs(phase - (PERIOD - 0.01)) < 1e-6
        if at_end or (abs(phase - 2.0) < 1e-6 and since > PERIOD):
            R = quaternion_to_matrix(true.orientation) @ quaternion_to_matrix(estimate.orientation).T
            C = estimate.pose_covariance
            w = log_rotation(R)
            nees.append([off @ np.linalg.solve(C[:3, :3], off), w @ np.linalg.solve(C[3:, 3:], w)])
        if at_end:
            ends.append(float(np.linalg.norm(off)))
        elif since > PERIOD and 0.2 <= phase < PERIOD - OUTAGE:
            errors.append(float(np.linalg.norm(off)))
    return ends, nees, errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["euroc", "simulator"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--seeds", default="0-20", help="from, and the one to stop before")
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    first, stop = (int(word) for word in arguments.seeds.split("-"))
    began, all_ends, all_nees, squares = time.process_time(), [], [], []
    for seed in range(first, stop):
        if arguments.what == "euroc":
            rmse, ends, text = euroc(arguments.folder, seed)
            print(
                f"seed {seed}: RMSE {rmse * 100:.2f} cm; outages' ends {np.round(ends, 2).tolist()} m; {text}",
                flush=True,
            )
            squares.append(rmse**2)
        else:
            ends, nees, errors = simulator(seed)
            all_nees.append(nees)
            squares.append(float(np.mean(np.square(errors))))
            print(
                f"seed {seed}: RMSE {math.sqrt(squares[-1]) * 100:.1f} cm; ends {np.round(ends, 2).tolist()} m",
                flush=True,
            )
        all_ends += ends
    each = np.sqrt(squares) * 100
    print(f"RMSE {math.sqrt(np.mean(squares)) * 100:.2f} cm, worst seed {each.max():.2f} cm")
    rmse = math.sqrt(np.mean(np.square(all_ends)))
    print(f"outages' ends: RMSE {rmse:.3f} m, largest {max(all_ends):.3f} m of {len(all_ends)}")
    if all_nees:
        from scipy.stats import chi2

        runs = len(all_nees)
        low, high = chi2.ppf([0.025, 0.975], 3 * runs) / runs
        print(f"ANEES (position, orientation) over {runs} runs, 95 % band {low:.2f}-{high:.2f}; at ends and 2 s after:")
        print(np.round(np.mean(all_nees, axis=0), 2).tolist())
    print(f"{time.process_time() - began:.0f} s CPU")


if __name__ == "__main__":
    main()
