"""Each sensor in turn is dropped, frozen, blacked out and miscalibrated while the core perception graph runs.

    python benchmarks/sensor_failure.py [--seconds 8] [--from 3 --to 5] [--only depth] [--out failures.json]

The bundled recording is handed to a `PerceptionSystem` with all five sensors. In the span, what the faulty one gives is
left out (dropped), its last measurement again (frozen), or black, without return, without points, zeros (black). Two
faults last for the whole drive: a sensor that is turned by 3 degrees against its extrinsics (tilted: forward, the IMU),
and one that is misscaled, which gives 5 % more than there is.

Error of the pose: distance from the truth, the two laid on each other where the first pose is. AP50 of the images in
the span (blind ones count: what could be seen in them is missed). Map and relations as at the end of the drive. A
status speaks where an operator warns more often than in the drive without fault; `silent` marks a fault of which none
does.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import dataflow
from dataflow.messages import Detections2D, Message, Odometry, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.supervision.core.report import RunFailed
from operators.codec import DepthDecoder, ImageDecoder
from operators.evaluation import DetectionMetrics, SceneGraphMetrics
from operators.perception import PerceptionResult, PerceptionSystem

DEMO = Path(__file__).resolve().parents[1] / "recordings" / "demo.mcap"
STREAMS = {"image": "image_jpeg", "depth": "depth_png", "points": "points", "imu": "imu", "wheels": "wheel_odometry"}
TRUTH = ("objects", "scene", "true_base")
TURNED = {
    "image turned": ("camera_color_optical", "y"),
    "depth turned": ("camera_depth_optical", "y"),
    "points turned": ("lidar", "z"),
    "imu turned": ("imu", "z"),
    "imu tilted": ("imu", "y"),
}
KINDS = ("dropped", "frozen", "black", "turned", "tilted", "misscaled")
MISSCALED = ("depth", "points", "imu", "wheels")
TURN, SCALE = np.deg2rad(3.0), 1.05
Steps = dict[int, dict[str, Any]]


def read(seconds: float) -> tuple[Steps, Steps, dict[str, Message]]:
    """What the sensors measured and the truth by stamp, and the calibrations."""
    whole = dataflow.open(DEMO)
    part = whole.between(0, seconds)
    decoders: dict[str, Any] = {"image": ImageDecoder(), "depth": DepthDecoder()}
    measured: Steps = {}
    for name, stream in STREAMS.items():
        for message in part[stream]:
            made = decoders[name].decode(message) if name in decoders else message
            measured.setdefault(message.stamp, {})[name] = made
    true: Steps = {}
    for name in TRUTH:
        for message in part[name]:
            true.setdefault(message.stamp, {})[name] = message
    statics = {name: whole[name][0] for name in ("image_info", "depth_info", "extrinsics")}
    return dict(sorted(measured.items())), true, statics


def blacked(name: str, message: Any) -> Any:
    """The measurement of a sensor that shows nothing."""
    if name in ("image", "depth"):
        return message.replace(data=np.zeros_like(message.data))
    if name == "points":
        return message.replace(points=np.zeros((0, 3), np.float32), intensities=None, time_offsets=None, rings=None)
    if name == "imu":
        return message.replace(angular_velocity=np.zeros(3), linear_acceleration=np.zeros(3))
    return message.replace(linear=np.zeros(3), angular=np.zeros(3))


def misscaled(name: str, message: Any) -> Any:
    if name == "depth":
        return message.replace(data=message.data * np.float32(SCALE))
    if name == "points":
        return message.replace(points=message.points * np.float32(SCALE))
    if name == "imu":
        return message.replace(angular_velocity=message.angular_velocity * SCALE)
    return message.replace(linear=message.linear * SCALE, angular=message.angular * SCALE)


def turned(extrinsics: Transforms, frame: str, axis: str) -> Transforms:
    """The extrinsics with one frame turned about one of its axes."""
    at = extrinsics.child_frames.index(frame)
    rotations = extrinsics.rotations.copy()
    rotations[at] = (Rotation.from_quat(rotations[at]) * Rotation.from_euler(axis, TURN)).as_quat()
    return extrinsics.replace(rotations=rotations)


def there(sensor: str, kind: str) -> bool:
    """Returns whether a sensor has such a fault."""
    if kind in ("turned", "tilted"):
        return f"{sensor} {kind}" in TURNED
    return kind != "misscaled" or sensor in MISSCALED


def faulty(measured: Steps, sensor: str, kind: str, first: int, last: int) -> Steps:
    """The measurements with the fault in [first, last]."""
    changed: Steps = {}
    held: Message | None = None
    for stamp, step in measured.items():
        given = dict(step)
        if sensor in step and kind == "misscaled":
            given[sensor] = misscaled(sensor, step[sensor])
        elif sensor in step and first <= stamp <= last and kind in ("dropped", "frozen", "black"):
            if kind == "dropped" or (kind == "frozen" and held is None):
                del given[sensor]
            elif kind == "frozen":
                assert held is not None
                given[sensor] = held.replace(stamp=stamp)
            else:
                given[sensor] = blacked(sensor, step[sensor])
        elif sensor in step:
            held = step[sensor]
        changed[stamp] = given
    return changed


def rows_of(boxes: Detections2D, rows: np.ndarray[Any, Any]) -> Detections2D:
    return Detections2D(
        stamp=boxes.stamp,
        frame=boxes.frame,
        width=boxes.width,
        height=boxes.height,
        class_names=boxes.class_names,
        boxes=boxes.boxes[rows],
        scores=boxes.scores[rows],
        class_ids=boxes.class_ids[rows],
    )


class Figures:
    """Scores of one drive."""

    def __init__(self, first: int, last: int) -> None:
        self.first, self.last = first, last
        self.detections, self.scene = DetectionMetrics(score_threshold=0.4, min_pixels=50), SceneGraphMetrics(pixels=50)
        self.detections.setup()
        self.scene.setup()
        self.warnings: Counter[str] = Counter()
        self.words: dict[str, str] = {}
        self.errors: list[float] = []
        self.made: Counter[str] = Counter()
        self._seen: list[Any] = []
        self._pose: Odometry | None = None
        self._start: np.ndarray[Any, Any] | None = None

    def add(self, result: PerceptionResult, true: Mapping[str, Any]) -> None:
        for name, status in result.status.items():
            levels = [int(level) for level in status.levels]
            if levels and max(levels) >= Level.WARN:
                self.warnings[name] += 1
                if self.first <= result.stamp:
                    self.words.setdefault(name, status.messages[int(np.argmax(levels))])
        inside = self.first <= result.stamp <= self.last
        if inside:
            self.made.update(result.made().keys())
        if "objects" in true:
            self._seen.append(true["objects"])
            if inside:
                none = np.zeros(true["objects"].count, np.bool_)
                self.detections.process(result.detections or rows_of(true["objects"], none), (true["objects"],))
        self._pose = result.pose or self._pose
        if result.pose is not None and "true_base" in true:
            if self._start is None:
                self._start = true["true_base"].matrix() @ np.linalg.inv(result.pose.matrix())
            placed = self._start @ result.pose.matrix()
            self.errors.append(float(np.linalg.norm(placed[:3, 3] - true["true_base"].position)))
        if "scene" in true and result.graph is not None and self._pose is not None and "true_base" in true:
            self.scene.process(result.graph, true["scene"], self._pose, true["true_base"], tuple(self._seen))
            self._seen = []

    def summary(self) -> dict[str, Any]:
        self.detections.finish()
        scene, boxes = self.scene.summary(), self.detections.summary()
        return {
            "rms": float(np.sqrt(np.mean(np.square(self.errors)))) if self.errors else float("nan"),
            "max": max(self.errors, default=float("nan")),
            "ap50": boxes.get("ap50", float("nan")) if boxes.get("frames") else float("nan"),
            "images": self.made["detections"],
            "recall": scene.get("node_recall", float("nan")),
            "precision": scene.get("node_precision", float("nan")),
            "relations": scene.get("relations_f1_mapped", float("nan")),
            "made": dict(self.made),
            "warnings": dict(self.warnings),
            "words": self.words,
        }


def drive(measured: Steps, true: Steps, statics: Mapping[str, Any], first: int, last: int) -> dict[str, Any]:
    figures = Figures(first, last)
    with PerceptionSystem(tuple(STREAMS), **statics) as system:
        for stamp, step in measured.items():
            figures.add(system.process(stamp, **step), true.get(stamp, {}))
    return figures.summary()


def table(rows: Mapping[str, dict[str, Any]]) -> str:
    lines = [
        "| fault | pose rms / max (m) | AP50 (images) | map recall / precision | relations F1 | reported by |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    usual = rows.get("none", {"warnings": {}})["warnings"]
    for name, row in rows.items():
        spoken = {who: n - usual.get(who, 0) for who, n in row["warnings"].items() if n > usual.get(who, 0)}
        said = "; ".join(f"{who} ({row['words'].get(who, 'before')})" for who in spoken) or "**silent**"
        said = said.replace("perception/", "").replace("/odometry", "")
        lines.append(
            f"| {name} | {row['rms']:.3f} / {row['max']:.3f} | {row['ap50']:.2f} ({row['images']}) "
            f"| {row['recall']:.2f} / {row['precision']:.2f} | {row['relations']:.2f} "
            f"| {'' if name == 'none' else said} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--from", dest="first", type=float, default=3.0)
    parser.add_argument("--to", dest="last", type=float, default=5.0)
    parser.add_argument("--only", help="one sensor")
    parser.add_argument("--out", type=Path, help="JSON file of the figures; cases that it holds are not run again")
    options = parser.parse_args()
    measured, true, statics = read(options.seconds)
    start = min(measured)
    first, last = (start + round(at * 1e9) for at in (options.first, options.last))
    rows: dict[str, Any] = {}
    if options.out is not None and options.out.is_file():
        rows = json.loads(options.out.read_text(encoding="utf-8"))
    cases = [("", ""), *((s, k) for s in STREAMS if options.only in (None, s) for k in KINDS if there(s, k))]
    for sensor, kind in cases:
        name = f"{sensor} {kind}".strip() or "none"
        if name in rows:
            continue
        given: dict[str, Any] = dict(statics)
        if name in TURNED:
            given["extrinsics"] = turned(given["extrinsics"], *TURNED[name])
        try:
            rows[name] = drive(faulty(measured, sensor, kind, first, last), true, given, first, last)
        except RunFailed as failure:
            rows[name] = {"failed": str(failure)}
            print(name, failure, flush=True)
            continue
        print(table({"none": rows["none"], name: rows[name]}).splitlines()[-1], flush=True)
        if options.out is not None:
            options.out.write_text(json.dumps(rows), encoding="utf-8")
    done = {name: row for name, row in rows.items() if "failed" not in row}
    print(table(done))


if __name__ == "__main__":
    main()
