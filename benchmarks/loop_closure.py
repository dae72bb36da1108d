"""Where the nodes of a map are at the end of a drive with a loop: by odometry alone, by SLAM, and with its keyframes.

    python benchmarks/loop_closure.py office:701 [corridor:703] [--duration 60]

A simulated robot drives rounds (`route: round`, 0.8 m/s) through a world of a seed, with an RGB-D camera of 10 images a
second with a depth camera's noise and nothing else: no inertial sensor, no wheels, no LiDAR. Boxes and masks are the
simulator's, so that the figures tell of places alone. The drive, the same to the bit, is mapped by
`graphs/core/perception.yaml` three times: the pose is the visual odometry's; SLAM's, but the map does not get its
keyframes; SLAM's with keyframes (`slam: true`). Things that stand and are right by class within 1 m of a true one are
compared with it; a double is a second one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TypeVar

import numpy as np
import yaml

import dataflow
from dataflow.messages import Odometry, SceneGraph
from dataflow.messages.geometry import invert, transform_points
from operators.labels import LabelSpace, labels_file

M = TypeVar("M")
REPOSITORY = Path(__file__).resolve().parent.parent
NEAR = 1.0
LABELS = "simulator"
WAYS = {"odometry": "false", "SLAM without keyframes": "true", "SLAM with keyframes": "true"}


def graph(world: str, seed: int, duration: float) -> dict[str, object]:
    given = {name: f"robot/{name}" for name in ("image", "depth", "image_info", "depth_info", "extrinsics")}
    robot = {
        "use": "operators.simulator:SimulatedRobot",
        "params": {
            "world": world, "seed": seed, "route": "round", "duration": f"{duration:g}s", "speed": 0.8,
            "first_stamp": 1_700_000_000_000_000_000,
            "color_camera": {"rate": 10},
            "depth_camera": {"rate": 10, "noise": 0.0012, "grain": 4, "quantum": 0.0025},
            "truth": {"poses": 10, "boxes": True, "masks": True, "relations": 1, "activities": 0},
        },
    }  # fmt: skip
    perception = {
        "use": str(REPOSITORY / "graphs" / "core" / "perception.yaml"),
        "inputs": given | {"detected": "robot/objects", "segmented": "robot/masks"},
        "params": {"labels": LABELS, "slam": "${slam}", "stride": 3},
    }
    score = {
        "use": "operators.evaluation:TrajectoryMetrics",
        "inputs": {"estimate": "perception/odometry", "ground_truth": "robot/true_base"},
    }
    return {
        "graph": "loop_closure",
        "params": {"slam": False},
        "operators": {"robot": robot, "perception": perception, "score": score},
        "record": {"topics": ["robot/true_base", "robot/scene", "perception/**/odometry", "perception/**/graph"]},
    }


def run(file: Path, out: Path, *more: str) -> None:
    words = [sys.executable, "-m", "dataflow.cli.main", "run", str(file), *more]
    words += ["--record", str(out), "--overwrite", "--json"]
    done = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=3000)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stderr}")


def all_of(file: Path, end: str, kind: type[M]) -> list[M]:
    recorded = dataflow.open(file)
    name = next(n for n in recorded if n.endswith(end))
    return [m for m in recorded[name] if isinstance(m, kind)]


def errors(file: Path, pose: str) -> tuple[list[float], int]:
    """Returns how far nodes are from the things that they are, metres, and how many doubles there are."""
    labels = LabelSpace.read(Path(labels_file(LABELS)))
    made, truth = all_of(file, "scene/graph", SceneGraph)[-1], all_of(file, "robot/scene", SceneGraph)[-1]
    posed = {m.stamp: m for m in all_of(file, pose, Odometry)}
    true = {m.stamp: m for m in all_of(file, "robot/true_base", Odometry)}
    first = min(posed.keys() & true.keys())
    places = transform_points(true[first].matrix() @ invert(posed[first].matrix()), made.positions)
    off, taken, doubles = [], set(), 0
    for k in range(made.count):
        label = made.class_names[made.class_ids[k]]
        if made.ids[k] <= 0 or "agent" in labels.roles(label):
            continue
        same = [j for j in range(truth.count) if truth.class_names[truth.class_ids[j]] == label and truth.ids[j] > 0]
        apart = np.linalg.norm(truth.positions[same] - places[k], axis=1) if same else np.array([np.inf])
        nearest = int(apart.argmin())
        if apart[nearest] < NEAR:
            doubles += same[nearest] in taken
            taken.add(same[nearest])
            off.append(float(apart[nearest]))
    return off, doubles


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="+", help="world:seed")
    parser.add_argument("--duration", type=float, default=60)
    arguments = parser.parse_args()
    print("| world | pose | nodes | off, median | 90 % | most | doubles |\n" + "| --- " * 7 + "|")
    for each in arguments.worlds:
        world, seed = each.split(":")
        with tempfile.TemporaryDirectory() as folder:
            for way, slam in WAYS.items():
                made = graph(world, int(seed), arguments.duration)
                if way == "SLAM without keyframes":
                    core = yaml.safe_load((REPOSITORY / "graphs" / "core" / "perception.yaml").read_text())
                    del core["operators"]["objects"]["inputs"]["keyframes"]
                    (Path(folder) / "core.yaml").write_text(yaml.safe_dump(core, sort_keys=False))
                    made["operators"]["perception"]["use"] = str(Path(folder) / "core.yaml")  # type: ignore[index]
                file, out = Path(folder) / "graph.yaml", Path(folder) / "out.mcap"
                file.write_text(yaml.safe_dump(made, sort_keys=False))
                run(file, out, "--set", f"slam={slam}")
                off, doubles = errors(out, "base/odometry" if slam == "false" else "placed/odometry")
                figures = (100 * np.percentile(off, [50, 90, 100])).tolist() if off else [np.nan] * 3
                told = " | ".join(f"{f:.1f} cm" for f in figures)
                print(f"| {world} {seed} | {way} | {len(off)} | {told} | {doubles} |", flush=True)


if __name__ == "__main__":
    main()
