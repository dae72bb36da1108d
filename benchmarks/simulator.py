"""Times the simulated robot: whole set-ups against real time, and each sensor by itself.

python benchmarks/simulator.py
python benchmarks/simulator.py --against TREE    beside another checkout, the two in turns
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2

from operators.simulator import SimulatedRobot

HERE = Path(__file__).resolve().parents[1]
WORLDS = ("office", "corridor", "table_top")
VGA = {"width": 640, "height": 480}
SMALL = {"width": 320, "height": 240}
NOTHING: dict[str, Any] = {
    "color_camera": {"rate": 0},
    "depth_camera": {"rate": 0},
    "truth": {"poses": 0, "boxes": False, "relations": 0, "activities": 0},
}
TRUTH = {"poses": 10, "boxes": True, "relations": 1, "activities": 5, "masks": True}
DEMO: dict[str, Any] = {
    "color_camera": {**SMALL, "output": "jpeg", "jpeg_quality": 80},
    "depth_camera": {"output": "png"},
    "lidar": {"rate": 5},
    "inertial": {"rate": 100},
    "wheels": {"rate": 20},
    "truth": TRUTH,
}
SETUPS: dict[str, dict[str, Any]] = {
    "colour + depth, 640x480, 10 Hz": {"color_camera": VGA, "depth_camera": {}},
    "colour + depth, 320x240, 10 Hz": {"color_camera": SMALL, "depth_camera": {}},
    "the same with boxes, masks, poses, activities, relations": {
        "color_camera": SMALL, "depth_camera": {}, "truth": TRUTH,
    },
    "all of the bundled recording": DEMO,
}  # fmt: skip
SENSORS: dict[str, dict[str, Any]] = {
    "colour, 640x480": {"color_camera": VGA},
    "colour, 320x240": {"color_camera": SMALL},
    "colour with JPEG, 320x240": {"color_camera": {**SMALL, "output": "both"}},
    "depth, 640x480": {"color_camera": {**VGA, "rate": 0}, "depth_camera": {}},
    "depth, 320x240": {"color_camera": {**SMALL, "rate": 0}, "depth_camera": {}},
    "depth with PNG, 320x240": {"color_camera": {**SMALL, "rate": 0}, "depth_camera": {"output": "both"}},
    "stereo pair, 2 x 320x240": {"stereo": {"rate": 10}},
    "LiDAR, 16x360": {"lidar": {"rate": 10}},
    "LiDAR, 64x1024": {"lidar": {"rate": 10, "rings": 64, "columns": 1024}},
    "radar": {"radar": {"rate": 10}},
    "landmark sightings": {"landmarks": {"rate": 10}},
    "IMU": {"inertial": {"rate": 100}},
    "magnetometer": {"magnetometer": {"rate": 100}},
    "wheels": {"wheels": {"rate": 50}},
    "satellite fixes": {"gnss": {"rate": 10}},
    "poses": {"truth": {**NOTHING["truth"], "poses": 10}},
    "activities": {"truth": {**NOTHING["truth"], "activities": 10}},
    "scene graph": {"truth": {**NOTHING["truth"], "relations": 10}},
}


def timed(params: dict[str, Any], seconds: float, repeats: int) -> tuple[float, float, int]:
    """Seconds that a span of simulated time takes, by the clock and of all threads' computing, and its steps.

    Of every step the least of all repeats counts.

    Every repeat computes the same, so the least is what a step takes when nothing disturbs it. Set-up and the first
    second are left out.
    """
    clock: list[float] = []
    computing: list[float] = []
    for _ in range(repeats):
        robot = SimulatedRobot(**{**NOTHING, **params, "duration": f"{seconds + 1}s"})
        robot.setup()
        spans, begin = [], (time.perf_counter(), time.process_time())
        for step in robot.stream():
            end = time.perf_counter(), time.process_time()
            if next(iter(step.values())).stamp >= 1_000_000_000:
                spans.append((end[0] - begin[0], end[1] - begin[1]))
            begin = time.perf_counter(), time.process_time()
        clock = [min(k, s[0]) for k, s in zip(clock, spans, strict=True)] if clock else [s[0] for s in spans]
        computing = (
            [min(k, s[1]) for k, s in zip(computing, spans, strict=True)] if computing else [s[1] for s in spans]
        )
    return sum(clock), sum(computing), len(clock)


def against(other: Path, seconds: float, repeats: int) -> None:
    """CPU of this checkout over that of another, each in new processes, in turns; the least of each counts."""
    print("| what | world | other, ms of CPU a second | this | ratio |\n| --- | --- | --- | --- | --- |")
    for name in SETUPS:
        for world in WORLDS:
            least: dict[Path, float] = {}
            for _ in range(repeats):
                for tree in (other, HERE):
                    command = [sys.executable, __file__, "--cpu", name, world, "--seconds", str(seconds)]
                    environment = {**os.environ, "PYTHONPATH": str(tree)}
                    answer = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
                    least[tree] = min(least.get(tree, float("inf")), float(answer.stdout))
            row = f"{least[other]:.0f} | {least[HERE]:.0f} | {least[HERE] / least[other]:.2f}"
            print(f"| {name} | {world} | {row} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2, help="simulated time of each run")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each; of every step the fastest counts")
    parser.add_argument("--against", type=Path, help="another checkout to compare with")
    parser.add_argument("--cpu", nargs=2, metavar=("SETUP", "WORLD"), help="print the ms of CPU of one and no more")
    arguments = parser.parse_args()
    if arguments.against is not None:
        against(arguments.against.resolve(), arguments.seconds, arguments.repeats)
        return
    if arguments.cpu is not None:
        cv2.setNumThreads(1)
        name, world = arguments.cpu
        _, cpu, _ = timed({**SETUPS[name], "world": world}, arguments.seconds, 1)
        print(1000 * cpu / arguments.seconds)
        return

    print("| what | world | threads | ms a second of the world | ms of CPU | x real time | x by CPU |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, params in SETUPS.items():
        for world in WORLDS if "640x480" in name else ("office",):
            for threads in (1, 2):
                cv2.setNumThreads(threads)
                given = {**params, "world": world, "threads": threads}
                clock, cpu, _ = (
                    part / arguments.seconds for part in timed(given, arguments.seconds, arguments.repeats)
                )
                row = f"{1000 * clock:.0f} | {1000 * cpu:.0f} | {1 / clock:.1f} | {1 / cpu:.1f}"
                print(f"| {name} | {world} | {threads} | {row} |", flush=True)

    print("\n| sensor | ms a measurement | ms of CPU |\n| --- | --- | --- |")
    cv2.setNumThreads(1)
    for name, params in SENSORS.items():
        clock, cpu, steps = timed(params, arguments.seconds, arguments.repeats)
        print(f"| {name} | {1000 * clock / steps:.2f} | {1000 * cpu / steps:.2f} |", flush=True)


if __name__ == "__main__":
    main()
