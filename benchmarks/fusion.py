"""Error-state fusion on EuRoC's inertial data and on the simulator: accuracy, outages, consistency.

    python benchmarks/fusion.py euroc DATA/euroc_v1_01_imu --seeds 0-20
    python benchmarks/fusion.py simulator --seeds 0-50
    python benchmarks/fusion.py hours --seeds 0-10 --seconds 3600

EuRoC: positions at 20 Hz are the truth with 2 cm of noise an axis and 10 % outliers of 0.5 m an axis; the last 3 s of
every 12 s have none. The RMSE leaves out the first 0.2 s after an outage; the heading is not given. Simulator: inertial
samples, positions of 2 cm horizontally, 4 cm vertically at 20 Hz, none in the last 3 s of every 12 s, made of the true
trajectories of its worlds; NEES of position and orientation at the end of each outage and 2 s after. Hours: the same at
50 Hz with positions at 5 Hz, drives of even seeds with wheels at 10 Hz: warnings where nothing is wrong, NEES and the
standard deviation that is claimed.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

PERIOD, OUTAGE = 12.0, 3.0
_DIGITS = re.compile(r"\d+(\.\d+)?")


def fed(operator: Any, samples: Sequence[Any], others: Sequence[Any]) -> Iterator[Any]:
    """Gives an operator its messages in the order of their stamps; yields its odometry."""
    for given in fired(operator, samples, others):
        if given["odometry"] is not None:
            yield given["odometry"]


def fired(operator: Any, samples: Sequence[Any], others: Sequence[Any]) -> Iterator[Any]:
    """Gives an operator its messages in the order of their stamps; yields its outputs."""
    from dataflow.messages import Odometry
    from dataflow.operator import Context

    names = {samples[0].SCHEMA: "ns/sensor/imu", Odometry.SCHEMA: "ns/sensor/wheels"}
    for message in sorted([*samples, *others], key=lambda m: (m.stamp, m.SCHEMA)):
        name = names.get(message.SCHEMA, "ns/sensor/fix")
        given = operator.process({name: message}, Context(message.stamp))
        if given is not None:
            yield given


@cache
def recorded(folder: Path) -> tuple[list[Any], list[Any]]:
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
    from operators.fusion.sensors.settings import SensorSettings

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
                Pose(
                    stamp=pose.stamp,
                    frame="world",
                    child_frame="imu",
                    position=place,
                    orientation=np.array([0.0, 0.0, 0.0, 1.0]),
                )
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
    health = operator.state.filter.health["sensor/fix"]  # type: ignore[union-attr]
    text = f"used {health.used}, refused {health.refused}, unconfirmed {health.unconfirmed}, made room {health.widened}"
    return math.sqrt(float(np.mean(np.square(errors)))), ends, text


def fixes_of(stamps: Sequence[int], truth: Mapping[int, Any], lever: Any, rng: np.random.Generator) -> list[Any]:
    """Returns positions of an antenna (3,) on the body with 2 cm of noise, 4 cm vertically, none in outages."""
    from dataflow.messages import Pose

    sigma = np.array([0.02, 0.02, 0.04])
    covariance = np.diag([*sigma**2, 1.0, 1.0, 1.0])
    fixes = []
    for stamp in stamps:
        if stamp * 1e-9 % PERIOD < PERIOD - OUTAGE:
            place = truth[stamp][:3, :3] @ lever + truth[stamp][:3, 3] + sigma * rng.standard_normal(3)
            fixes.append(
                Pose(
                    stamp=stamp,
                    frame="world",
                    child_frame="gnss",
                    position=place,
                    orientation=np.array([0.0, 0.0, 0.0, 1.0]),
                    covariance=covariance,
                )
            )
    return fixes


def driven(  # type: ignore[no-untyped-def]
    seed: int, seconds: int, rate: int = 100, speed: float = 0.5, bias: tuple[float, float] = (0.005, 0.05)
):
    """Inertial samples, positions of the antenna, true poses by stamp, and extrinsics of a drive in the simulator.

    They are made of the true trajectory: nothing is drawn, so that many runs are cheap.
    """
    from dataflow.messages import Imu, Transforms
    from operators.simulator.settings import Gnss, Inertial
    from operators.simulator.worlds.make import make_world

    rng = np.random.default_rng([seed, 7])
    imu, gnss = Inertial(), Gnss()
    world = ("office", "corridor", "table_top")[seed % 3]
    path = make_world(world, seed, speed=speed, hold=0.0, movers=False).path
    t = np.arange(seconds * rate) / rate
    motion = path.at(t)
    c, s = np.cos(motion.yaw), np.sin(motion.yaw)
    ax, ay = motion.acceleration.T
    flat = np.zeros(len(t))
    gyro = np.column_stack([flat, flat, motion.yaw_rate])
    turning = np.column_stack([flat, flat, motion.yaw_acceleration])
    lever = np.array(imu.mount[:3])
    force = np.column_stack([c * ax + s * ay, -s * ax + c * ay, flat + imu.gravity])
    force += np.cross(turning, lever) + np.cross(gyro, np.cross(gyro, lever))
    white = math.sqrt(rate)
    for value, biased, noise, walk in (
        (gyro, bias[0], imu.gyro_noise, imu.gyro_walk),
        (force, bias[1], imu.accel_noise, imu.accel_walk),
    ):
        value += rng.normal(0, biased, 3) + np.cumsum(rng.normal(0, walk / white, value.shape), axis=0)
        value += rng.normal(0, noise * white, value.shape)
    stamps = np.round(t * 1e9).astype(np.int64).tolist()
    C, D = np.eye(3) * (imu.gyro_noise * white) ** 2, np.eye(3) * (imu.accel_noise * white) ** 2
    samples = [
        Imu(
            stamp=stamp,
            frame="imu",
            angular_velocity=w,
            linear_acceleration=f,
            angular_velocity_covariance=C,
            linear_acceleration_covariance=D,
        )
        for stamp, w, f in zip(stamps, gyro, force, strict=True)
    ]
    truth = dict(zip(stamps, motion.T_world_base(), strict=True))
    fixes = fixes_of(stamps[:: max(rate // 20, 1)], truth, gnss.mount[:3], rng)
    extrinsics = Transforms(
        stamp=0,
        frames=("base_link", "base_link"),
        child_frames=("imu", "gnss"),
        translations=np.array([imu.mount[:3], gnss.mount[:3]]),
        rotations=np.tile([0.0, 0, 0, 1], (2, 1)),
    )
    heading = float(motion.yaw[rate // 2]) + 0.05 * rng.standard_normal()
    return samples, fixes, truth, extrinsics, heading


def simulator(
    seed: int, seconds: int, slip: float | None
) -> tuple[list[float], list[list[float]], list[float], list[float]]:
    """Errors at the outages' ends (m); NEES of position and orientation there and 2 s after; errors between them; the
    root of the trace of the position's covariance at the ends (m), which is what the filter expects of the errors."""
    from dataflow.messages.geometry import quaternion_to_matrix
    from operators.fusion import EkfFusion
    from operators.fusion.filter.error_state import log_rotation
    from operators.fusion.sensors.settings import SensorSettings

    samples, fixes, truth, extrinsics, heading = driven(seed, seconds)
    operator = EkfFusion(
        gyro_bias=0.005,
        accel_bias=0.05,
        heading=heading,
        heading_sigma=0.05,
        rest=0.5,
        patience=0.5,
        slip=slip,
        sensors={"sensor/fix": SensorSettings(use="position")},
    )
    operator.setup()
    mounted = SimpleNamespace(process=lambda messages, context: operator.process(messages, context, extrinsics))
    ends, nees, errors, expected = [], [], [], []
    for estimate in fed(mounted, samples, fixes):
        true = truth[estimate.stamp]
        since = estimate.stamp * 1e-9
        off = true[:3, 3] - estimate.position
        phase = since % PERIOD
        at_end = abs(phase - (PERIOD - 0.01)) < 1e-6
        if at_end or (abs(phase - 2.0) < 1e-6 and since > PERIOD):
            C = estimate.pose_covariance
            w = log_rotation(true[:3, :3] @ quaternion_to_matrix(estimate.orientation).T)
            nees.append([off @ np.linalg.solve(C[:3, :3], off), w @ np.linalg.solve(C[3:, 3:], w)])
        if at_end:
            ends.append(float(np.linalg.norm(off)))
            expected.append(math.sqrt(float(np.trace(C[:3, :3]))))
        elif since > PERIOD and 0.2 <= phase < PERIOD - OUTAGE:
            errors.append(float(np.linalg.norm(off)))
    return ends, nees, errors, expected


def wheels_of(
    truth: Mapping[int, Any], every: int, rng: np.random.Generator, wrong: tuple[float, float] = (0, 0), by: float = 1.0
) -> list[Any]:
    """Returns odometry of wheels of every so many true poses (4, 4) by stamp, with noise of 1 cm/s and 0.01 rad/s;
    between two times (s) they turn by a factor of what they should."""
    from dataflow.messages import Odometry
    from operators.geometry import se3

    made, stamps = [], sorted(truth)
    for before, stamp in list(pairwise(stamps))[::every]:
        twist = se3.log(np.linalg.inv(truth[before]) @ truth[stamp]) / ((stamp - before) * 1e-9)
        made.append(
            Odometry(
                stamp=stamp,
                frame="odom",
                child_frame="base_link",
                position=np.zeros(3),
                orientation=np.array([0.0, 0, 0, 1]),
                linear=np.array(
                    [(twist[0] + rng.normal(0, 0.01)) * (by if wrong[0] <= stamp * 1e-9 < wrong[1] else 1.0), 0, 0]
                ),
                angular=np.array([0, 0, twist[5] + rng.normal(0, 0.01)]),
                twist_covariance=np.eye(6) * 1e-4,
            )
        )
    return made


def faultless(seed: int, seconds: int) -> tuple[list[str], list[float], list[float]]:
    """Returns the warnings of a drive without faults, and NEES/3 of the position and its deviation (m) every 10 s.

    A warning whose figures change is one, as in the viewer's log.
    """
    from dataflow.messages.diagnostics import Level
    from operators.fusion import EkfFusion
    from operators.fusion.sensors.settings import SensorSettings

    samples, fixes, truth, extrinsics, heading = driven(seed, seconds, 50)
    others = fixes[::5]  # of 25 Hz
    sensors = {"sensor/fix": SensorSettings(use="position")}
    if seed % 2 == 0:
        others = [*others, *wheels_of(truth, 5, np.random.default_rng([seed, 8]))]
        sensors["sensor/wheels"] = SensorSettings(use="wheels", sigma=0.03)
    operator = EkfFusion(heading=heading, heading_sigma=0.05, rest=0.5, patience=0.5, sensors=sensors)
    operator.setup()
    mounted = SimpleNamespace(process=lambda messages, context: operator.process(messages, context, extrinsics))
    warnings, nees, claimed, standing = list[str](), list[float](), list[float](), set[tuple[str, str]]()
    for given in fired(mounted, samples, others):
        if (status := given["status"]) is not None:
            rows = zip(status.names, status.levels, status.messages, strict=True)
            now = {(name, _DIGITS.sub("", text)): text for name, level, text in rows if level == Level.WARN}
            warnings += [f"{status.stamp * 1e-9:.1f} s {key[0]}: {now[key]}" for key in sorted(now.keys() - standing)]
            standing = set(now)
        pose = given["odometry"]
        if pose is not None and pose.stamp > 10**10 and pose.stamp % 10**10 == 0:
            off, C = truth[pose.stamp][:3, 3] - pose.position, pose.pose_covariance[:3, :3]
            nees.append(float(off @ np.linalg.solve(C, off)) / 3)
            claimed.append(math.sqrt(float(np.trace(C))))
    return warnings, nees, claimed


def hours(seeds: range, seconds: int) -> None:
    """Prints what a filter warns of, and how sure it is, in drives without faults."""
    counts, every, deviations = 0, list[float](), list[float]()
    for seed in seeds:
        warnings, nees, claimed = faultless(seed, seconds)
        counts, every, deviations = counts + len(warnings), every + nees, deviations + claimed
        print(
            f"seed {seed}: {len(warnings)} warnings, NEES/3 {np.mean(nees):.2f}, claims {np.mean(claimed):.4f} m",
            flush=True,
        )
        print("".join(f"  {text}\n" for text in warnings), end="", flush=True)
    spent = len(seeds) * seconds / 3600
    print(f"{counts} warnings in {spent:.2f} h; NEES/3 {np.mean(every):.2f} of {len(every)} poses; "
          f"claims {np.mean(deviations):.4f} m")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["euroc", "simulator", "hours"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--seconds", type=int, default=36, help="of a made drive")
    parser.add_argument("--seeds", default="0-20", help="from, and the one to stop before")
    parser.add_argument("--slip", type=float, help="m/s: the robot rolls (simulator; `EkfFusion`'s parameter)")
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    first, stop = (int(word) for word in arguments.seeds.split("-"))
    if arguments.what == "hours":
        hours(range(first, stop), arguments.seconds)
        return
    began, all_ends, all_nees, all_expected, squares = time.process_time(), [], [], [], []
    for seed in range(first, stop):
        if arguments.what == "euroc":
            rmse, ends, text = euroc(arguments.folder, seed)
            print(
                f"seed {seed}: RMSE {rmse * 100:.2f} cm; outages' ends {np.round(ends, 2).tolist()} m; {text}",
                flush=True,
            )
            squares.append(rmse**2)
        else:
            ends, nees, errors, expected = simulator(seed, arguments.seconds, arguments.slip)
            all_nees.append(nees)
            all_expected += expected
            squares.append(float(np.mean(np.square(errors))) if errors else math.nan)
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
        print(f"the filter expects {math.sqrt(np.mean(np.square(all_expected))):.3f} m RMS at the ends")
        each_run = len(all_ends) // runs
        firsts = all_ends[::each_run]
        later = [one for k, one in enumerate(all_ends) if k % each_run]
        for name, some in (("first", firsts), ("later", later)):
            rmse = math.sqrt(np.mean(np.square(some))) if some else math.nan
            print(f"{name} outages' ends: RMSE {rmse:.3f} m, largest {max(some, default=math.nan):.3f} m")
    print(f"{time.process_time() - began:.0f} s CPU")


if __name__ == "__main__":
    main()
