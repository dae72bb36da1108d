"""Standing and driving on a real street, and the car in front: the graph of camera and LiDAR, labelled by hand.

    python benchmarks/street.py DATA [--detector fastestdet] [--set NAME=VALUE]

DATA is the folder of shared data. `graphs/perception_kitti.yaml` runs on its 24 images and scans (2.3 s; the car drives
5.2 m). Truth was read off all scans laid over each other by their odometry, where what stands is sharp and what drives
is smeared: by lane, in the frame of the first scan. A vehicle counts in each image in which it was just seen and has an
activity; `unknown` is counted apart.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import dataflow
from dataflow.messages import Activity, SceneGraph

REPOSITORY = Path(__file__).resolve().parent.parent
DETECTORS = {"yolox_nano": "yolox_nano.onnx", "fastestdet": "FastestDet.onnx"}
VEHICLES = ("car", "truck", "bus", "train", "motorcycle", "bicycle")
REAR, SPEED, LENGTH, SIDES = 8.0, 1.52, 4.6, (-1.4, 0.9)
"""The car in front: its rear at first (m ahead), its speed (m/s), and how long and where aside it is (m)."""


def true_activity(x: float, y: float) -> str | None:
    """Returns whether what is at a place drives; None between the lanes."""
    if y > 1.5:
        return "resting"  # the lane to the left waits
    if -1.7 < y < 1.2:
        return "driving"
    if y < -2.0:
        return "driving" if x < 24 else "resting"  # the tanker that overtakes; two cars that are parked ahead
    return None


def record(data: Path, detector: str, settings: Sequence[str], file: Path) -> None:
    given = [f"data={data}", f"detector={data / 'models' / DETECTORS[detector]}", *settings]
    command = [sys.executable, "-m", "dataflow.cli.main", "run", str(REPOSITORY / "graphs" / "perception_kitti.yaml")]
    command += [part for value in given for part in ("--set", value)]
    command += ["--record", str(file), "--overwrite", "--one-process", "--json"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=1800)
    if done.returncode:
        raise SystemExit(f"the graph failed:\n{done.stderr}")


def judged(file: Path) -> str:
    """Returns the figures of a recording as a row."""
    stream = dataflow.open(file)
    graphs, activities = (
        list(stream[next(name for name in stream if name.endswith(end))]) for end in ("scene/graph", "scene/activities")
    )
    told: Counter[tuple[str, str]] = Counter()
    front: list[list[int]] = []
    for graph, acts in zip(graphs, activities, strict=True):
        assert isinstance(graph, SceneGraph)
        assert isinstance(acts, Activity)
        assert graph.last_seen is not None
        said = {int(i): acts.class_names[c] for i, c in zip(acts.subjects, acts.class_ids, strict=True)}
        front.append([])
        rear = REAR + SPEED * graph.stamp * 1e-9
        for k, i in enumerate(graph.ids.tolist()):
            if i <= 0 or graph.class_names[graph.class_ids[k]] not in VEHICLES:
                continue
            x, y = graph.positions[k, :2].tolist()
            if rear - 0.5 < x < rear + LENGTH and SIDES[0] < y < SIDES[1]:
                front[-1].append(i)
            true = true_activity(x, y)
            if true is not None and i in said and graph.last_seen[k] == graph.stamp:
                told[true, said[i]] += 1
    known = sum(n for (_, said), n in told.items() if said != "unknown")
    right = sum(n for (true, said), n in told.items() if said == true)
    parts = [
        f"{sum(told[t, s] for s in ('driving', 'resting', 'unknown'))} {t}: {told[t, 'driving']} driving, "
        f"{told[t, 'resting']} resting, {told[t, 'unknown']} unknown"
        for t in ("resting", "driving")
    ]
    ids, doubles = {i for each in front for i in each}, sum(len(each) > 1 for each in front)
    seen = int(np.count_nonzero([len(each) > 0 for each in front]))
    followed = f"{len(ids)} ids in {seen} of {len(front)} images, {doubles} with two"
    return f"{right} of {known} | {' / '.join(parts)} | {followed}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--detector", choices=DETECTORS, action="append")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="as of dataflow run")
    parser.add_argument("--recording", type=Path, help="judge this one")
    options = parser.parse_args()
    print("| | right | of those that truly rest, drive | the car in front |\n| --- | --- | --- | --- |")
    if options.recording is not None:
        print(f"| {options.recording.name} | {judged(options.recording)} |")
        return
    for detector in options.detector or DETECTORS:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "street.mcap"
            record(options.data.resolve(), detector, options.set, file)
            print(f"| {detector} | {judged(file)} |", flush=True)


if __name__ == "__main__":
    main()
