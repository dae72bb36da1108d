"""Localisation by particles in the simulator's worlds: error, time until the robot is found again, time an update.

    python benchmarks/localize.py run office:21-24 table_top:21-24 yard:21-24     worlds and seeds, from and up to
    python benchmarks/localize.py degrade office:21                               a lidar that is knocked
    python benchmarks/localize.py ambiguous corridor:15-18                        a world that looks the same twice
    python benchmarks/localize.py time                                            1,000 particles, no adaptation
    python benchmarks/localize.py map office 7 office_7.yaml                      saves a true map

The robot starts anywhere, unknown, and is carried elsewhere at 15, 30 and 45 s of 60. It is found when ten poses in a
row are within 10 cm and 2 degrees of the truth; errors are those of all poses from then to the next carrying.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Streams = dict[str, list[Any]]
KIDNAPS = ((15.0, 0.37), (30.0, 0.5), (45.0, 0.23))
SENSORS = {"lidar": ("points",), "landmarks": ("sightings",), "both": ("points", "sightings")}


def drive(world: str, seed: int, seconds: int = 60, kidnaps: Any = KIDNAPS, faults: Any = ()) -> tuple[Any, Streams]:
    """The streams of a drive, static ones apart."""
    from operators.simulator import SimulatedRobot

    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{seconds}s",
        color_camera={"rate": 0},
        depth_camera={"rate": 0},
        lidar={"rate": 10, "rings": 4, "columns": 180, "lower": -0.1, "upper": 0.15},
        landmarks={"rate": 5},
        wheels={"rate": 20},
        inertial={"rate": 50, "gyro_bias": (0.003, -0.002, 0.004)},
        kidnaps=[{"at": at, "ahead": ahead} for at, ahead in kidnaps],
        faults=list(faults),
        truth={"poses": 20, "relations": 0, "activities": 0, "boxes": False, "occupancy": True},
    )
    robot.setup()
    static = robot.static_outputs()
    streams: Streams = {}
    for step in robot.stream():
        for port, message in step.items():
            streams.setdefault(port, []).append(message)
    robot.close()
    return static, streams


def localized(static: Any, streams: Streams, sensors: Sequence[str], **params: Any) -> tuple[Any, Any]:
    """Plays the operator; returns what it gives and itself."""
    from dataflow.testing import play
    from operators.localization import ParticleFilterLocalizer

    operator = ParticleFilterLocalizer(**params)
    inputs: dict[str, Any] = {
        "odometry": streams["wheel_odometry"],
        "measurements": {port: streams[port] for port in (*sensors, "imu")},
        "extrinsics": [static["extrinsics"]],
        "landmark_map": [static["landmark_map"]],
        "map": [static["occupancy"]],
    }
    return play(operator, inputs, static=("extrinsics", "landmark_map", "map"), paranoid=False), operator


def errors(poses: Sequence[Any], truth: Sequence[Any]) -> NDArray[np.float64]:
    """Rows of time (s), distance (m) and turn (deg) from the truth."""
    from dataflow.messages.geometry import yaw_of

    true = {pose.stamp: pose for pose in truth}
    rows = []
    for pose in poses:
        at = true[pose.stamp]
        turn = (float(yaw_of(pose.orientation) - yaw_of(at.orientation)) + math.pi) % (2 * math.pi) - math.pi
        rows.append((pose.stamp * 1e-9, float(np.hypot(*(pose.position - at.position)[:2])), abs(math.degrees(turn))))
    return np.array(rows).reshape(-1, 3)


def found(rows: np.ndarray, begin: float, end: float) -> tuple[float, np.ndarray]:
    """Seconds until ten poses in a row are right (infinite if never), and the rows from then on."""
    span = rows[(rows[:, 0] >= begin) & (rows[:, 0] < end)]
    right = (span[:, 1] <= 0.1) & (span[:, 2] <= 2.0)
    for k in range(len(span) - 9):
        if right[k : k + 10].all():
            return float(span[k, 0] - begin), span[k:]
    return math.inf, span[:0]


def run(worlds: list[str]) -> None:
    print("world, seed, sensors: found after start / carryings (s); RMSE, 99 %, worst (cm); RMSE, worst (deg); wrong")
    tally: dict[tuple[str, str], list[float]] = {}
    for entry in worlds:
        world, _, seeds = entry.partition(":")
        first, _, stop = seeds.partition("-")
        for seed in range(int(first), int(stop or int(first) + 1)):
            static, streams = drive(world, seed)
            for name, sensors in SENSORS.items():
                played, _ = localized(static, streams, sensors, modality_particles=0)
                rows = errors(played["pose"], streams["true_base"])
                begins = [0.0, *(at for at, _ in KIDNAPS)]
                spans = [found(rows, a, b) for a, b in zip(begins, [*begins[1:], 61.0], strict=True)]
                good = np.vstack([span for _, span in spans])
                wrong = float((rows[:, 1] > 0.5).sum()) / 20
                tally.setdefault((world, name), []).extend(after for after, _ in spans[1:])
                text = f"{world} {seed} {name}: " + " / ".join(f"{after:.2f}" for after, _ in spans)
                if len(good):
                    d, a = good[:, 1] * 100, good[:, 2]
                    text += f"; {math.sqrt((d**2).mean()):.1f}, {np.percentile(d, 99):.1f}, {d.max():.1f}"
                    text += f"; {math.sqrt((a**2).mean()):.2f}, {a.max():.2f}"
                print(f"{text}; {wrong:.2f} s of poses off by 0.5 m or more", flush=True)
    for (world, name), after in tally.items():
        count = sum(seconds <= 10 for seconds in after)
        print(f"{world}, {name}: found again within 10 s {count} of {len(after)}, latest {max(after):.2f} s")


def degrade(worlds: list[str]) -> None:
    """A lidar turned by six degrees from 20 s on, and landmarks seen 0.6 m too far from 40 s on."""
    faults = (
        {"sensor": "lidar", "span": [20, 36], "set": {"mount_error": [0, 0, 0, 0, 0, 0.1]}},
        {"sensor": "landmarks", "span": [40, 60], "set": {"bias": 0.6}},
    )
    for entry in worlds:
        world, _, seed = entry.partition(":")
        static, streams = drive(world, int(seed), kidnaps=(), faults=faults)
        played, _ = localized(static, streams, SENSORS["both"])
        for port in ("pose", "lidar_pose", "landmark_pose"):
            rows = errors(played[port], streams["true_base"])
            text = []
            for begin, end in ((2, 20), (20, 36), (40, 60)):
                span = rows[(rows[:, 0] >= begin) & (rows[:, 0] < end)]
                text.append(
                    f"{begin}-{end} s {100 * math.sqrt((span[:, 1] ** 2).mean()):.1f} cm {span[:, 2].mean():.2f}°"
                )
            print(f"{world} {seed} {port}: " + ", ".join(text))
        for status in played["status"]:
            if round(status.stamp * 1e-9) in (10, 30, 50):
                print(round(status.stamp * 1e-9), "s:", dict(zip(status.names, status.messages, strict=True)))


def ambiguous(worlds: list[str]) -> None:
    """Shares of 30 s in which the robot is said to be somewhere, rightly or wrongly, or to be in one of two places."""
    for entry in worlds:
        world, _, seeds = entry.partition(":")
        first, _, stop = seeds.partition("-")
        for seed in range(int(first), int(stop or int(first) + 1)):
            static, streams = drive(world, seed, seconds=30, kidnaps=())
            for name in ("lidar", "both"):
                played, operator = localized(static, streams, SENSORS[name], modality_particles=0)
                rows = errors(played["pose"], streams["true_base"])
                total = len(streams["wheel_odometry"])
                wrong = int((rows[:, 1] > 0.5).sum())
                words = {word: n for word, n in operator.summary().items() if word.startswith("poses ")}
                print(
                    f"{world} {seed} {name}: right {(len(rows) - wrong) / total:.0%}, wrong {wrong / total:.0%}, "
                    f"ambiguous {words.get('poses ambiguous', 0) / total:.0%}; {words}",
                    flush=True,
                )


def measure() -> None:
    """CPU time of single updates with 1,000 particles, one thread, the look for another place included."""
    from operators.localization.weighted_cloud import WeightedCloud

    static, streams = drive("office", 21, seconds=20, kidnaps=())
    times: dict[str, list[float]] = {}
    update, move = WeightedCloud.update, WeightedCloud.move

    def timed(name: str, method: Any) -> Any:
        def call(self: Any, *arguments: Any) -> Any:
            began, injected = time.process_time(), self.injected
            result = method(self, *arguments)
            kind = name if name == "move" else f"update {type(arguments[2]).__name__}"
            kind += ", with injection" if self.injected > injected else ""
            times.setdefault(kind, []).append(1e3 * (time.process_time() - began))
            return result

        return call

    WeightedCloud.update, WeightedCloud.move = timed("update", update), timed("move", move)  # type: ignore[method-assign]
    localized(static, streams, SENSORS["both"], min_particles=1000, max_particles=1000, modality_particles=0)
    for kind, spans in sorted(times.items()):
        print(f"{kind}: median {np.median(spans):.2f} ms, 95 % {np.percentile(spans, 95):.2f} ms of {len(spans)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["run", "degrade", "ambiguous", "time", "map"])
    parser.add_argument("words", nargs="*")
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    if arguments.what == "map":
        from operators.localization.map_file import write_map

        world, seed, file = arguments.words
        write_map(drive(world, int(seed), seconds=1)[0]["occupancy"], Path(file))
    elif arguments.what == "time":
        measure()
    else:
        {"run": run, "degrade": degrade, "ambiguous": ambiguous}[arguments.what](arguments.words)


if __name__ == "__main__":
    main()
