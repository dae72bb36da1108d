"""Positions and poses from several sensors, combined by their covariances: error, consistency, and who is named.

    python benchmarks/combination.py                 20 seeds
    python benchmarks/combination.py --seeds 100-110

Positions: six things 3 to 9 m before a robot, seen ten times a second for 20 s by two cameras 0.8 m apart (bearing and
elevation, 2 mrad) and by a lidar (3 cm an axis). Poses: a body on a winding way, posed by visual odometry (2 cm, 0.4
degrees), lidar (3 cm, 0.3 degrees) and wheels (6 cm, 1 degree), its orientation by an inertial unit (0.5 degrees). All
errors are drawn anew for each message, so only the fusion reduces them. The second half is scored: in it, one sensor
has ten times the error that its covariances state, or is knocked (turned by 25 mrad, or moved by
30 cm). NEES / n is 1 where the covariances are right. *Named*: the share of status messages of the second half that
report that sensor as contradicting the others or as worse than its covariance.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dataflow.messages import Diagnostics, Imu, LandmarkSightings, Message, Pose, Transforms
from dataflow.testing import Played, play
from operators.fusion import PoseFusion, PositionFusion

Array = NDArray[np.float64]
STEP, COUNT = 100_000_000, 200
EYES = {"left": np.array([0.0, 0.4, 1.0]), "right": np.array([0.0, -0.4, 1.0])}
LIDAR = np.array([0.0, 0.0, 1.5])
TURNED, MOVED, WORSE = 0.025, 0.3, 10.0
BAD = ("contradicts the others", "worse than")
"""Beginnings of the status texts that name a faulty sensor."""

Fault = tuple[str, str]
"""Sensor, and `worse` or `knocked`."""


def faulty(k: int, name: str, fault: Fault | None, kind: str) -> bool:
    return fault == (name, kind) and k >= COUNT // 2


def places(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(3, 9, 6), rng.uniform(-3, 3, 6), rng.uniform(0.2, 2, 6)])


def sightings(name: str, things: Array, seed: int, fault: Fault | None) -> list[Message]:
    rng = np.random.default_rng([seed, 1 + [*EYES, "lidar"].index(name)])
    made: list[Message] = []
    for k in range(COUNT):
        growth = WORSE if faulty(k, name, fault, "worse") else 1.0
        given: dict[str, Any] = {"stamp": (k + 1) * STEP, "frame": name, "ids": np.arange(len(things))}
        if name == "lidar":
            moved = [MOVED, 0, 0] if faulty(k, name, fault, "knocked") else [0, 0, 0]
            given["positions"] = things - LIDAR + moved + rng.normal(0, 0.03 * growth, things.shape)
            given["covariances"] = np.tile(np.eye(3) * 0.03**2, (len(things), 1, 1))
        else:
            way = things - EYES[name]
            turned = TURNED if faulty(k, name, fault, "knocked") else 0.0
            noise = rng.normal(0, 0.002 * growth, (2, len(things)))
            given["bearings"] = np.arctan2(way[:, 1], way[:, 0]) + turned + noise[0]
            given["elevations"] = np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1])) + noise[1]
            given["covariances"] = np.tile(np.eye(2) * 0.002**2, (len(things), 1, 1))
        made.append(LandmarkSightings(**given))
    return made


def position_errors(
    seed: int, sensors: tuple[str, ...], fault: Fault | None
) -> tuple[list[float], list[float], Played]:
    """Errors (m) and NEES / 3 of the second half."""
    mounts = Transforms(
        stamp=0,
        frames=("base_link",) * 3,
        child_frames=(*EYES, "lidar"),
        translations=np.array([*EYES.values(), LIDAR]),
        rotations=np.tile([0, 0, 0, 1.0], (3, 1)),
    )
    things = places(seed)
    streams = {name: sightings(name, things, seed, fault) for name in sensors}
    operator = PositionFusion()
    played = play(operator, {"sightings": streams, "extrinsics": [mounts]}, static=("extrinsics",), paranoid=False)
    errors, nees = [], []
    for message in played["places"]:
        assert isinstance(message, LandmarkSightings)
        assert message.positions is not None
        assert message.covariances is not None
        if message.stamp <= COUNT // 2 * STEP:
            continue
        for i, found, C in zip(message.ids.tolist(), message.positions, message.covariances, strict=True):
            off = found - things[i]
            errors.append(float(np.linalg.norm(off)))
            nees.append(float(off @ np.linalg.solve(C, off)) / 3)
    return errors, nees, played


POSED = {"visual": (0.02, 0.4), "lidar": (0.03, 0.3), "wheels": (0.06, 1.0), "imu": (0.0, 0.5)}
"""Standard deviations: metres an axis, degrees an axis."""


def way(seed: int) -> tuple[Array, Rotation]:
    rng = np.random.default_rng([seed, 100])
    t = np.arange(COUNT) * STEP * 1e-9
    phase = rng.uniform(0, 2 * math.pi, 3)
    points = np.column_stack([0.5 * t, 2 * np.sin(0.3 * t + phase[0]), 0.1 * np.sin(0.2 * t + phase[1])])
    yaw = 0.8 * np.sin(0.3 * t + phase[2])
    return points, Rotation.from_euler("zyx", np.column_stack([yaw, 0.05 * np.sin(t), 0.05 * np.cos(t)]))


def estimates(name: str, truth: tuple[Array, Rotation], seed: int, fault: Fault | None) -> list[Message]:
    rng = np.random.default_rng([seed, 200 + [*POSED].index(name)])
    far, turn = POSED[name][0], math.radians(POSED[name][1])
    made: list[Message] = []
    for k in range(COUNT):
        growth = WORSE if faulty(k, name, fault, "worse") else 1.0
        knocked = faulty(k, name, fault, "knocked")
        turned = Rotation.from_rotvec(rng.normal(0, turn * growth, 3) + ([0, 0, 4 * TURNED] if knocked else [0, 0, 0]))
        quaternion = (turned * truth[1][k]).as_quat()
        stamp = (k + 1) * STEP
        if name == "imu":
            made.append(
                Imu(
                    stamp=stamp,
                    frame="base_link",
                    angular_velocity=np.zeros(3),
                    linear_acceleration=np.zeros(3),
                    orientation=quaternion,
                    orientation_covariance=np.eye(3) * turn**2,
                )
            )
            continue
        place = truth[0][k] + rng.normal(0, far * growth, 3) + ([MOVED, 0, 0] if knocked else [0, 0, 0])
        covariance = np.diag([far**2] * 3 + [turn**2] * 3)
        made.append(
            Pose(
                stamp=stamp,
                frame="world",
                child_frame="base_link",
                position=place,
                orientation=quaternion,
                covariance=covariance,
            )
        )
    return made


def pose_errors(
    seed: int, sensors: tuple[str, ...], fault: Fault | None
) -> tuple[list[float], list[float], list[float], Played]:
    """Errors in metres and degrees, and NEES / 6, of the second half."""
    truth = way(seed)
    played = play(
        PoseFusion(), {"estimates": {name: estimates(name, truth, seed, fault) for name in sensors}}, paranoid=False
    )
    far, turned, nees = [], [], []
    for message in played["pose"]:
        assert isinstance(message, Pose)
        assert message.covariance is not None
        k = message.stamp // STEP - 1
        if k < COUNT // 2:
            continue
        off = np.empty(6)
        off[:3] = message.position - truth[0][k]
        off[3:] = (Rotation.from_quat(message.orientation) * truth[1][k].inv()).as_rotvec()
        far.append(float(np.linalg.norm(off[:3])))
        turned.append(math.degrees(float(np.linalg.norm(off[3:]))))
        nees.append(float(off @ np.linalg.solve(message.covariance, off)) / 6)
    return far, turned, nees, played


def named(played: Played, fault: Fault | None, port: str) -> Iterator[bool]:
    for status in played["status"]:
        assert isinstance(status, Diagnostics)
        if fault is not None and status.stamp > COUNT // 2 * STEP + 1_000_000_000:
            texts = dict(zip(status.names, status.messages, strict=True))
            yield texts.get(f"{port}/{fault[0]}", "").startswith(BAD)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


CASES: Mapping[str, tuple[tuple[str, ...], Fault | None]] = {
    "cameras": (("left", "right"), None),
    "lidar": (("lidar",), None),
    "both": (("left", "right", "lidar"), None),
    "both, lidar worse than its covariance": (("left", "right", "lidar"), ("lidar", "worse")),
    "both, lidar moved": (("left", "right", "lidar"), ("lidar", "knocked")),
    "both, a camera turned": (("left", "right", "lidar"), ("right", "knocked")),
}
POSE_CASES: Mapping[str, tuple[tuple[str, ...], Fault | None]] = {
    "visual": (("visual",), None),
    "lidar": (("lidar",), None),
    "wheels, inertial": (("wheels", "imu"), None),
    "all four": (("visual", "lidar", "wheels", "imu"), None),
    "all four, visual worse than its covariance": (("visual", "lidar", "wheels", "imu"), ("visual", "worse")),
    "all four, lidar moved and turned": (("visual", "lidar", "wheels", "imu"), ("lidar", "knocked")),
    "two, lidar moved and turned": (("visual", "lidar"), ("lidar", "knocked")),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0-20", help="from, and the one to stop before")
    arguments = parser.parse_args()
    first, _, last = arguments.seeds.partition("-")
    seeds = range(int(first), int(last))
    share: Callable[[list[bool]], str] = lambda told: f"{np.mean(told):.0%}" if told else ""  # noqa: E731
    print("| positions of things | RMSE, cm | worst seed | NEES / 3 | named |\n| --- | --- | --- | --- | --- |")
    for case, (sensors, fault) in CASES.items():
        runs = [position_errors(seed, sensors, fault) for seed in seeds]
        told = [one for run in runs for one in named(run[2], fault, "sightings")]
        every = [error for run in runs for error in run[0]]
        nees = float(np.mean([n for run in runs for n in run[1]]))
        worst = max(rms(run[0]) for run in runs)
        print(f"| {case} | {100 * rms(every):.1f} | {100 * worst:.1f} | {nees:.2f} | {share(told)} |", flush=True)
    print("\n| pose of a body | RMSE, cm | degrees | worst seed, cm | NEES / 6 | named |")
    print("| --- | --- | --- | --- | --- | --- |")
    for case, (sensors, fault) in POSE_CASES.items():
        posed = [pose_errors(seed, sensors, fault) for seed in seeds]
        told = [one for run in posed for one in named(run[3], fault, "estimates")]
        far = [value for run in posed for value in run[0]]
        turned = [value for run in posed for value in run[1]]
        nees = float(np.mean([value for run in posed for value in run[2]]))
        worst = max(rms(run[0]) for run in posed)
        print(
            f"| {case} | {100 * rms(far):.1f} | {rms(turned):.2f} | {100 * worst:.1f} | {nees:.2f} | {share(told)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
