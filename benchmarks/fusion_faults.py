"""Sensors that are wrong, fused: how often the error stays within three claimed deviations, or a warning is out.

    python benchmarks/fusion_faults.py [FAULT ...] [--seeds 1-4] [--seconds 30]

Inertial samples at 100 Hz on true paths of the simulator's worlds, at up to 0.8 m/s; positions of 5 cm at 5 Hz with an
outage from 12 to 17 s where wheels are at fault, wheels at 20 Hz. Shares are of the poses after the fault began (or of
all from 1 s on); a pose counts as warned of while a warning of any sensor is at most a second old. *Rotation* is the
median of NEES/3 of the orientation.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fusion import driven, wheels_of

from dataflow.messages import Pose
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import matrix_to_quaternion, quaternion_to_matrix
from dataflow.operator import Context
from operators.fusion import EkfFusion
from operators.fusion.filter.error_state import log_rotation

SIGMA = np.array([0.05, 0.05, 0.1])
ANTENNA = "gnss"


@dataclass(frozen=True)
class Fault:
    """Holds what is wrong from `begin` to `end` (s), and what is told of it."""

    begin: float = 1.0
    end: float = 1e9
    wheels: bool = False
    factor: float = 1.0  # of the wheels' speed
    outage: bool = False
    jump: float = 0.0  # metres, of the positions
    late: float = 0.0  # seconds that positions come late
    stamped: float = 0.0  # seconds by which their stamps are late
    heading: float = 0.0  # radians that the first heading is off
    off: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where the world is
    bias: tuple[float, float] = (0.005, 0.05)  # of the inertial sensor, rad/s and m/s²
    frozen: bool = False  # positions repeat the last one with new stamps
    unplugged: bool = False  # wheels report that they stand
    axes: tuple[int, int, int] = (0, 1, 2)  # of the inertial sensor: which comes as x, y and z
    exact: bool = False  # positions come with a covariance of zeros
    beside: float | None = None  # metres by which positions are off those of a second sensor, which poses the robot


FAULTS = {
    "none": Fault(),
    "wheels stand in an outage": Fault(13, 16, wheels=True, factor=0.0, outage=True),
    "wheels 1.5 times too fast in an outage": Fault(13, 16, wheels=True, factor=1.5, outage=True),
    "wheels 5 % too fast": Fault(wheels=True, factor=1.05),
    "positions jump by 5 m": Fault(20, 25, jump=5.0),
    "positions jump by 5 m, with wheels": Fault(20, 25, jump=5.0, wheels=True),
    "positions 1.5 s late": Fault(late=1.5),
    "UTM": Fault(off=(512345.6, 5412345.7, 560.0)),
    "stamps 0.5 s late": Fault(stamped=0.5),
    "stamps 0.5 s late, with wheels": Fault(stamped=0.5, wheels=True),
    "heading 0.5 rad off": Fault(heading=0.5),
    "begun in motion, biases told": Fault(bias=(0.05, 0.5)),
    "positions jump by 1.5 m": Fault(20, 25, jump=1.5),
    "positions jump by 1.5 m, with wheels": Fault(20, 25, jump=1.5, wheels=True),
    "positions freeze": Fault(20, frozen=True),
    "positions freeze, with wheels": Fault(20, frozen=True, wheels=True),
    "wheels unplugged": Fault(wheels=True, unplugged=True),
    "wheels unplugged on the way": Fault(15, wheels=True, unplugged=True),
    "positions jump by 5 m while wheels stand": Fault(20, 25, jump=5.0, wheels=True, unplugged=True),
    "covariance of zeros": Fault(exact=True),
    "x and y of the inertial sensor swapped": Fault(axes=(1, 0, 2)),
    "x and z of the inertial sensor swapped": Fault(axes=(2, 1, 0)),
    "x and z of the inertial sensor swapped, with wheels": Fault(axes=(2, 1, 0), wheels=True),
    "positions of another origin": Fault(beside=20.0),
}


def sensed(fault: Fault, seed: int, seconds: int) -> tuple[list[tuple[int, str, Any]], dict[int, Any], Any, float]:
    """Returns messages by the time at which they come, true poses (4, 4) by stamp, extrinsics, and a heading."""
    samples, _, truth, extrinsics, heading = driven(seed, seconds, speed=0.8, bias=fault.bias)
    rng = np.random.default_rng([seed, 9])
    axes = list(fault.axes)
    events: list[tuple[int, str, Any]] = [
        (
            m.stamp,
            "imu",
            m.replace(angular_velocity=m.angular_velocity[axes], linear_acceleration=m.linear_acceleration[axes]),
        )
        for m in samples
    ]
    for T in truth.values():
        T[:3, 3] += fault.off
    events += fixes_of(fault, truth, extrinsics.translations[extrinsics.child_frames.index(ANTENNA)], rng)
    for wheels in wheels_of(truth, 5, rng, (fault.begin, fault.end), fault.factor) if fault.wheels else []:
        if fault.unplugged and fault.begin <= wheels.stamp * 1e-9 < fault.end:
            wheels = wheels.replace(linear=np.zeros(3), angular=np.zeros(3))
        events.append((wheels.stamp, "wheels", wheels))
    events = [e for e in events if e[0] <= samples[-1].stamp]
    return sorted(events, key=lambda e: e[:2]), truth, extrinsics, heading + fault.heading


def fixes_of(fault: Fault, truth: dict[int, Any], lever: Any, rng: np.random.Generator) -> list[tuple[int, str, Any]]:
    """Returns positions of an antenna (3,) on the body by the time at which they come, and what a second sensor saw."""
    events = list[tuple[int, str, Any]]()
    covariance = np.diag([*SIGMA**2, 1.0, 1.0, 1.0])
    last = np.zeros(3)
    for stamp in sorted(truth)[::20]:
        since, T = stamp * 1e-9, truth[stamp]
        place = T[:3, :3] @ lever + T[:3, 3] + SIGMA * rng.standard_normal(3)
        wrong = fault.begin <= since < fault.end
        place += np.array([fault.jump if wrong else 0.0, 0.0, 0.0])
        last = place = last if fault.frozen and wrong else place
        if fault.outage and 12 <= since < 17:
            continue
        told, comes = stamp + round(fault.stamped * 1e9), stamp + round(max(fault.late, fault.stamped) * 1e9)
        fix = Pose(
            stamp=told, frame="world", child_frame=ANTENNA, position=place, orientation=np.array([0.0, 0, 0, 1]),
            covariance=covariance * (not fault.exact),
        )  # fmt: skip
        if fault.beside is not None:
            near = np.diag([*SIGMA**2, 0.01, 0.01, 0.01])
            seen = T[:3, 3] + SIGMA * rng.standard_normal(3)
            turned = matrix_to_quaternion(T[:3, :3])
            pose = fix.replace(child_frame="base_link", position=seen, orientation=turned, covariance=near)
            events.append((comes, "pose", pose))
            fix = fix.replace(position=place + np.array([fault.beside, 0.0, 0.0]))
        events.append((comes, "fix", fix))
    return events


def run(fault: Fault, seed: int, seconds: int) -> tuple[NDArray[np.float64], str]:
    """Returns rows (N, 5): seconds, metres off, metres claimed, whether a warning is out, NEES/3 of the rotation.

    Beside them what the first warning after the fault began is about.
    """
    events, truth, extrinsics, heading = sensed(fault, seed, seconds)
    wheels = {"robot/wheels": {"use": "wheels", "sigma": 0.03}} if fault.wheels else {}
    told = {"gyro_bias": fault.bias[0], "accel_bias": fault.bias[1]} if fault.bias[0] > 0.01 else {}
    operator = EkfFusion(
        heading=heading, heading_sigma=0.05, rest=0.5, patience=0.5, **told,
        sensors={"robot/fix": {"use": "position"}} | wheels,
    )  # fmt: skip
    operator.setup()
    now, warned, rows, named = 0, -1e9, list[tuple[float, ...]](), ""
    for comes, name, message in events:
        now = max(now, comes)
        made = operator.process({f"ns/robot/{name}": message}, Context(now), extrinsics) or {}
        if (status := made.get("status")) is not None and max(status.levels, default=0) >= Level.WARN:
            warned = now * 1e-9
            if not named and warned >= fault.begin:
                named = next(n for n, level in zip(status.names, status.levels, strict=True) if level >= Level.WARN)
        pose = made.get("odometry")
        if name == "imu" and pose is not None and pose.stamp in truth:
            T, C = truth[pose.stamp], pose.pose_covariance
            w = log_rotation(T[:3, :3] @ quaternion_to_matrix(pose.orientation).T)
            off = float(np.linalg.norm(T[:3, 3] - pose.position))
            claimed = float(np.sqrt(np.trace(C[:3, :3])))
            rotation = float(w @ np.linalg.solve(C[3:, 3:], w)) / 3
            rows.append((now * 1e-9, off, claimed, now * 1e-9 - warned <= 1.0, rotation))
        elif name == "imu" and pose is None:
            rows.append((now * 1e-9, np.nan, np.nan, now * 1e-9 - warned <= 1.0, np.nan))
    return np.array(rows, np.float64), named.removeprefix("robot/") or "-"


def line(name: str, fault: Fault, runs: list[tuple[NDArray[np.float64], str]]) -> str:
    cells = [list[str]() for _ in range(6)]
    for rows, named in runs:
        after = rows[rows[:, 0] >= fault.begin]
        given = after[np.isfinite(after[:, 1])]
        warnings = after[after[:, 3] > 0, 0]
        within = given[:, 1] <= 3 * given[:, 2]
        cells[0].append(f"{given[:, 1].max():.2f}" if len(given) else "-")
        cells[1].append(f"{100 * within.mean():.0f}" if len(given) else "-")
        cells[2].append(f"{100 * (within | (given[:, 3] > 0)).mean():.0f}" if len(given) else "-")
        cells[3].append(f"{warnings[0] - fault.begin:.1f}" if len(warnings) else "never")
        cells[4].append(named)
        cells[5].append(f"{np.median(given[:, 4]):.2f}" if len(given) else "-")
    return f"| {name} | " + " | ".join(", ".join(cell) for cell in cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("faults", nargs="*", default=list(FAULTS), help=f"of {', '.join(FAULTS)}")
    parser.add_argument(
        "--seeds", default="1-4", help="from, and the one to stop before; a kind of world each, in turns"
    )
    parser.add_argument("--seconds", type=int, default=30)
    arguments = parser.parse_args()
    first, stop = (int(word) for word in arguments.seeds.split("-"))
    print(
        "| fault | largest error, m | within 3, % | within 3 or warned of, % | first warning after, s | of | rotation |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in arguments.faults:
        runs = [run(FAULTS[name], seed, arguments.seconds) for seed in range(first, stop)]
        print(line(name, FAULTS[name], runs), flush=True)


if __name__ == "__main__":
    main()
