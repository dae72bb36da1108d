"""2-D tracking against SORT and ByteTrack of the `trackers` package, on made detections, judged by trackeval.

    python benchmarks/tracking.py VENV [--seeds 10] [--search N]
    python benchmarks/tracking.py VENV --real

VENV is a virtual environment with `trackers`, `trackeval` and `motmetrics`, whose two ground truths are used beside the
simulator's. Detections are made from the truth by a seeded model: misses that come in spells, false boxes, jitter, and
scores that tell a little of each. `--search` tries N parameter sets of each peer on seeds that are not reported, and
reports the best as well. `--real`: the boxes that another program found in the images of the two street sequences, of
which `motmetrics` carries a tracker's output; its ids are left out, and it gives no scores.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.messages import Detections2D, TrackState
from operators.simulator.robot import SimulatedRobot
from operators.tracking.box_tracker import BoxTracker, BoxTrackerSettings

REPORTED, CHOSEN_ON = 100, 0
"""First seeds of the detections that are reported, and of those that parameters were chosen on."""
WORLDS = (("office", 0), ("corridor", 1), ("table_top", 2), ("office", 3))
SIZES = {"TUD-Campus": (640, 480), "TUD-Stadtmitte": (640, 480)}
SHOWN = 0.5
"""A track that is not matched now is scored while its probability is at least this."""
SEARCH = {
    "lost_track_buffer": (10, 91),
    "track_activation_threshold": (0.1, 0.9),
    "minimum_iou_threshold": (0.05, 0.7),
    "minimum_consecutive_frames": (1, 4),
}


def motmetrics_boxes(venv: Path, name: str, file_name: str = "gt.txt") -> list[list[list[float]]]:
    (file,) = venv.glob(f"lib/python3*/site-packages/motmetrics/data/{name}/{file_name}")
    frames: dict[int, list[list[float]]] = {}
    for row in csv.reader(file.open()):
        frame, id, x, y, w, h = (float(v) for v in row[:6])
        frames.setdefault(int(frame), []).append([id, x, y, x + w, y + h, 1.0])
    return [frames.get(k, []) for k in range(1, max(frames) + 1)]


def simulated_truth(world: str, seed: int, seconds: int) -> list[list[list[float]]]:
    """Objects (id, box, visible share) of each frame of a camera that drives through a world."""
    robot = SimulatedRobot(
        world=world,
        seed=seed,
        people=3,
        duration=f"{seconds}s",
        depth_camera={"rate": 0},
        truth={"poses": 0, "relations": 0, "activities": 0},
    )
    robot.setup()
    frames = []
    for messages in robot.stream():
        objects = messages.get("objects")
        if isinstance(objects, Detections2D):
            assert objects.ids is not None
            shares = objects.visible if objects.visible is not None else np.ones(objects.count)
            rows = zip(objects.ids.tolist(), objects.boxes.tolist(), shares.tolist(), strict=True)
            frames.append([[i, *box, share] for i, box, share in rows if share >= 0.3 and area(box) >= 100])
    robot.close()
    return frames


def area(box: list[float]) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])


def detected(truth: list[list[list[float]]], size: tuple[int, int], seed: int) -> list[list[list[float]]]:
    """Makes detections (x1, y1, x2, y2, score): spells of misses, weak scores when hidden, jitter, false boxes."""
    rng = np.random.default_rng(seed)
    blind: dict[float, int] = {}
    frames = []
    for objects in truth:
        found = []
        for id, x1, y1, x2, y2, visible in objects:
            blind[id] = blind.get(id, 0) - 1
            if blind[id] <= 0 and rng.random() < 0.015:
                blind[id] = int(rng.integers(3, 12))
            seen = 0.93 * min(1.0, visible / 0.6) if blind[id] <= 0 else 0.25
            mean = 0.5 + 0.35 * visible if blind[id] <= 0 else 0.3
            score = float(np.clip(rng.normal(mean, 0.13), 0.05, 0.99))
            jitter = rng.normal(0, 0.035 + 0.05 * (1 - score), 4) * [x2 - x1, y2 - y1, x2 - x1, y2 - y1]
            if rng.random() < seen:
                found.append([*(np.array([x1, y1, x2, y2]) + jitter).tolist(), score])
        for _ in range(rng.poisson(0.5)):
            w, h = np.array(size) * rng.uniform(0.04, 0.25, 2)
            x, y = rng.uniform(0, size[0] - w), rng.uniform(0, size[1] - h)
            found.append([x, y, x + w, y + h, float(np.clip(rng.beta(2.5, 4), 0.05, 0.95))])
        frames.append([f for f in found if f[2] > f[0] + 1 and f[3] > f[1] + 1])
    return frames


def ours(sequence: dict[str, Any], settings: BoxTrackerSettings) -> list[list[list[float]]]:
    tracker = BoxTracker(settings)
    result = []
    for k, frame in enumerate(sequence["frames"]):
        found = np.array(frame["found"], np.float64).reshape(-1, 5)
        stamp = round(k / sequence["rate"] * 1e9)
        classes = np.zeros(len(found), np.int32)
        tracks = tracker.update(stamp, found[:, :4], found[:, 4], classes, sequence["size"])
        shown = [
            t
            for t in tracks
            if t.state == TrackState.CONFIRMED or (t.state == TrackState.COASTING and t.score >= SHOWN)
        ]
        result.append([[t.id, *t.filter.box.tolist()] for t in shown])
    return result


def sequences(truths: dict[str, Any], seeds: range) -> dict[str, Any]:
    made = {}
    for name, (rate, size, truth) in truths.items():
        for seed in seeds:
            found = detected(truth, size, seed)
            frames = [{"truth": [r[:5] for r in t], "found": f} for t, f in zip(truth, found, strict=True)]
            made[f"{name}/{seed}"] = {"rate": rate, "size": size, "frames": frames}
    return made


def real_sequences(venv: Path) -> dict[str, Any]:
    """Returns the two street sequences with boxes that a program found in their images, all with the score 1."""
    made = {}
    for name, size in SIZES.items():
        truth = motmetrics_boxes(venv, name)
        found = motmetrics_boxes(venv, name, "test.txt")
        found += [[] for _ in range(len(truth) - len(found))]
        frames = [
            {"truth": [r[:5] for r in t], "found": [[*r[1:5], 1.0] for r in f]}
            for t, f in zip(truth, found, strict=True)
        ]
        made[f"{name}/real"] = {"rate": 25.0, "size": size, "frames": frames}
    return made


def judged(venv: Path, made: dict[str, Any], settings: dict[str, BoxTrackerSettings], peers: dict[str, Any]) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        results = {label: {name: ours(sequence, s) for name, sequence in made.items()} for label, s in settings.items()}
        for name, content in (("sequences", made), ("ours", results), ("peers", peers)):
            (Path(folder) / f"{name}.json").write_text(json.dumps(content))
        script = Path(__file__).parent / "peers" / "image_tracking.py"
        done = subprocess.run([venv / "bin/python", script, folder], check=False, capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stderr)
        return json.loads((Path(folder) / "figures.json").read_text())


def mean(figures: dict[str, dict[str, float]], metric: str) -> float:
    return float(np.mean([f[metric] for f in figures.values()]))


def bootstrap(first: dict[str, Any], second: dict[str, Any], metric: str) -> tuple[float, float]:
    """Returns the 2.5 and 97.5 percentiles of the mean difference over sequences and seeds, paired."""
    difference = np.array([first[name][metric] - second[name][metric] for name in first])
    rng = np.random.default_rng(0)
    means = difference[rng.integers(0, len(difference), (4000, len(difference)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5]).tolist()
    return low, high


def truths(venv: Path, first_world: int, seconds: int) -> dict[str, Any]:
    found: dict[str, Any] = {n: (25.0, size, motmetrics_boxes(venv, n)) for n, size in SIZES.items()}
    for world, offset in WORLDS:
        seed = first_world + offset
        found[f"{world} {seed}"] = (10.0, (320, 240), simulated_truth(world, seed, seconds))
    return found


def searched(venv: Path, made: dict[str, Any], tries: int) -> dict[str, Any]:
    """Returns the best of random parameter sets of each peer, by the mean of the three figures."""
    rng = np.random.default_rng(1)
    tried: dict[str, Any] = {}
    for k in range(tries):
        for use in ("SORTTracker", "ByteTrackTracker"):
            drawn = {n: float(rng.uniform(*r)) for n, r in SEARCH.items()}
            drawn |= {n: int(drawn[n]) for n in ("lost_track_buffer", "minimum_consecutive_frames")}
            if use == "ByteTrackTracker":
                drawn["high_conf_det_threshold"] = float(rng.uniform(0.3, 0.8))
            tried[f"{use} {k}"] = {"use": use, "parameters": drawn}
    figures = judged(venv, made, {}, tried)
    best = {}
    for use, label in (("SORTTracker", "SORT, searched"), ("ByteTrackTracker", "ByteTrack, searched")):
        of = [n for n in tried if n.startswith(use)]
        best[label] = tried[max(of, key=lambda n: sum(mean(figures[n], m) for m in ("HOTA", "IDF1", "MOTA")))]
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("venv", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--search", type=int, default=0)
    parser.add_argument("--real", action="store_true", help="on boxes that were found in real images")
    options = parser.parse_args()
    peers = {
        "SORT": {"use": "SORTTracker", "parameters": {}},
        "ByteTrack": {"use": "ByteTrackTracker", "parameters": {}},
    }
    if options.search:
        chosen_on = sequences(truths(options.venv, 500, 12), range(CHOSEN_ON, CHOSEN_ON + 2))
        peers |= searched(options.venv, chosen_on, options.search)
    if options.real:
        made = real_sequences(options.venv)
    else:
        made = sequences(truths(options.venv, 600, 20), range(REPORTED, REPORTED + options.seeds))
    figures = judged(options.venv, made, {"ours": BoxTrackerSettings()}, peers)
    print(f"{len(made)} sequences, {sum(len(s['frames']) for s in made.values())} frames")
    print("| tracker | HOTA | IDF1 | MOTA | worst HOTA | ours - it: HOTA | IDF1 | MOTA |\n" + "| --- " * 8 + "|")
    for label, found in figures.items():
        row = [f"{mean(found, m):.3f}" for m in ("HOTA", "IDF1", "MOTA")]
        row.append(f"{min(f['HOTA'] for f in found.values()):.3f}")
        for m in ("HOTA", "IDF1", "MOTA"):
            low, high = bootstrap(figures["ours"], found, m)
            row.append("" if label == "ours" else f"{low:+.3f} … {high:+.3f}")
        print(f"| {label} | " + " | ".join(row) + " |")
    for name in sorted({n.rpartition("/")[0] for n in made}):
        row = []
        for label, found in figures.items():
            part = {n: f for n, f in found.items() if n.startswith(f"{name}/")}
            row.append(f"{label} " + "/".join(f"{mean(part, m):.3f}" for m in ("HOTA", "IDF1", "MOTA")))
        print(f"{name}: " + "; ".join(row))


if __name__ == "__main__":
    main()
