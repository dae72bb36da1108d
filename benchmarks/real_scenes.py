"""The map of objects and relations in real rooms that were labelled by hand, from folders to figures.

    python benchmarks/real_scenes.py DATA [--detector fastestdet] [--scene fr1_rpy] [--set NAME=VALUE] [--keep FOLDER]

DATA is the folder of shared data. `graphs/perception_rgbd.yaml` runs on each of the three scenes with nothing set by
hand, and the scorer of the labels, `score_scene.py` beside them, rates its last graph. `often` counts, of the plain
things, those that the detector finds in three images or more: its box overlaps by half (IoU) the labelled one, which is
moved to each image by the labelled poses.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import dataflow
from dataflow.messages import CameraInfo, Detections2D, Transforms
from dataflow.messages.geometry import invert, matrix_to_quaternion, transform_points
from operators.geometry.extrinsics import transform_between
from operators.tracking.assignment import overlap

REPOSITORY = Path(__file__).resolve().parent.parent
SCENES = {"seven_0_249": ("rgbd_7scenes", 2), "fr1_rpy": ("scenes/fr1_rpy", 2), "cup_table": ("scenes/cup_table", 1)}
"""Folder of the frames, and which of them are taken."""
DETECTORS = {"yolox_nano": "yolox_nano.onnx", "fastestdet": "FastestDet.onnx"}
OFTEN, IOU = 3, 0.5
COUNTED = ("nodes_counted", "right", "found", "labelled", "doubles", "misplaced", "named_wrongly", "phantom")


def run(data: Path, scene: str, detector: str, settings: Sequence[str], recording: Path) -> float:
    """Records the graph on a scene; returns the milliseconds of CPU time an image that its operators took."""
    folder, stride = SCENES[scene]
    model = data / "models" / DETECTORS[detector]
    given = [f"camera.path={data / folder}", f"stride={stride}", f"detector={model}"]
    command = [sys.executable, "-m", "dataflow.cli.main", "run", str(REPOSITORY / "graphs" / "perception_rgbd.yaml")]
    command += [part for value in (*given, *settings) for part in ("--set", value)]
    command += ["--record", str(recording), "--overwrite", "--one-process", "--json"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=1800)
    if done.returncode:
        raise SystemExit(f"the graph failed on {scene}:\n{done.stderr}")
    operators: Mapping[str, Any] = json.loads(done.stdout)["operators"]
    spent = sum(float(each["cpu_ms"]) for name, each in operators.items() if name != "camera")
    return spent / max(int(operators["camera"]["firings"]), 1)


def scored(data: Path, scene: str, recording: Path) -> dict[str, Any]:
    """Returns the figures of the labels' scorer; prints its listing."""
    out = recording.with_suffix(".json")
    labels = data / "scenes" / f"{scene}.json"
    command = [sys.executable, str(labels.parent / "score_scene.py"), str(labels), str(recording), "--json", str(out)]
    command += ["--T", *first_camera(recording)]
    listing = subprocess.run(command, check=True, timeout=600, capture_output=True, text=True).stdout
    print(listing[: listing.index("\n{")], end="\n\n")
    figures: dict[str, Any] = json.loads(out.read_text())
    right = [line for line in listing.splitlines() if " RIGHT " in line]
    return figures | {"found_ids": [line[2:30].strip() for line in right]}


def first_camera(recording: Path) -> list[str]:
    """Returns the pose (x y z qx qy qz qw) of the first depth camera in the graph's frame, which begins at its base.

    The scorer would take the first pose of the base for it, which comes later where the first views leave it open.
    """
    stream = dataflow.open(recording)
    (mounted,) = (stream[name] for name in stream if name.endswith("mount/base_extrinsics"))
    (depth,) = (stream[name] for name in stream if name.endswith("camera/depth_info"))
    extrinsics, info = mounted[0], depth[0]
    assert isinstance(extrinsics, Transforms)
    assert isinstance(info, CameraInfo)
    T = transform_between(extrinsics, info.frame, "base_link")
    return [f"{number:.9f}" for number in (*T[:3, 3], *matrix_to_quaternion(T))]


def often_detected(data: Path, scene: str, recording: Path) -> list[str]:
    """Returns the plain things that the detector finds in `OFTEN` images or more."""
    labels = json.loads((data / "scenes" / f"{scene}.json").read_text())
    K = np.array(labels["K_color"])
    T_depth_image = matrix_of(labels["T_depth_image"])
    times = np.array([pose[1] for pose in labels["poses"]])
    T_first_camera = [matrix_of(pose[2:9]) @ T_depth_image for pose in labels["poses"]]
    stream = dataflow.open(recording)
    name = next(name for name in stream if name.endswith("detector/detections"))
    images = [m for m in stream[name] if isinstance(m, Detections2D)]
    start = images[0].stamp
    found: Counter[str] = Counter()
    for image in images:
        at = int(np.abs(times - times[0] - (image.stamp - start) * 1e-9).argmin())
        names = np.array(image.labels())
        for thing in (each for each in labels["objects"] if each["kind"] in ("object", "moving")):
            own = image.boxes[np.isin(names, thing["classes"])]
            box = moved_box(thing, at, times, T_first_camera, K)
            if box is not None and len(own):
                found[thing["id"]] += bool((overlap(own.astype(np.float64), box[None]) >= IOU).any())
    return [thing for thing, count in found.items() if count >= OFTEN]


def moved_box(
    thing: Mapping[str, Any],
    at: int,
    times: NDArray[np.float64],
    T_first_camera: Sequence[NDArray[np.float64]],
    K: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """Returns the labelled box (4,) that is nearest in time, moved to the image of pose `at`; None if behind it."""
    if thing["kind"] == "moving":
        boxes, centre = [each for each in thing["at"] if "box" in each], None
    else:
        boxes, centre = thing["boxes"], thing["centre"]
    if not boxes:
        return None
    nearest = min(boxes, key=lambda each: abs(each["t"] - times[at]))
    box = np.array(nearest["box"], np.float64)
    if centre is None:
        return box if abs(nearest["t"] - times[at]) < 0.5 else None
    there = int(np.abs(times - nearest["t"]).argmin())
    (u, v, z), (u0, v0, z0) = (_pixel(np.array(centre, np.float64), T_first_camera[k], K) for k in (at, there))
    if z <= 0.1 or z0 <= 0.1:
        return None
    corners = (box.reshape(2, 2) - [u0, v0]) * z0 / z + [u, v]
    return np.asarray(corners.ravel())


def _pixel(
    place: NDArray[np.float64], T_first_camera: NDArray[np.float64], K: NDArray[np.float64]
) -> tuple[float, ...]:
    x, y, z = transform_points(invert(T_first_camera), place[None])[0]
    return float(K[0, 0] * x / z + K[0, 2]), float(K[1, 1] * y / z + K[1, 2]), float(z)


def matrix_of(numbers: Sequence[float]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
    return T


def row(name: str, f: Mapping[str, Any]) -> str:
    """Returns a line of the table."""
    strict = f.get("relation_precision_strict")
    return (
        f"| {name} | {f['right']} of {f['nodes_counted']} ({f['right'] / max(f['nodes_counted'], 1):.2f}) "
        f"| {f['found']} of {f['labelled']} ({f['found'] / max(f['labelled'], 1):.2f}) "
        f"| {f['found_often']} of {f['often']} | {f['doubles']} | {f['misplaced']} | {f['named_wrongly']} "
        f"| {f['phantom']} | {'' if strict is None else strict} | {f.get('relation_recall_of_evaluable', '')} "
        f"| {f['ms']:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--detector", choices=DETECTORS, action="append")
    parser.add_argument("--scene", choices=SCENES, action="append")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="as of dataflow run")
    parser.add_argument("--keep", type=Path, help="folder for the recordings")
    options = parser.parse_args()
    lines = []
    with tempfile.TemporaryDirectory() as made:
        folder = options.keep or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        for detector in options.detector or DETECTORS:
            total: Counter[str] = Counter()
            for scene in options.scene or SCENES:
                recording = folder / f"{scene}_{detector}.mcap"
                ms = run(options.data.resolve(), scene, detector, options.set, recording)
                figures = scored(options.data, scene, recording) | {"ms": ms}
                often = often_detected(options.data, scene, recording)
                figures |= {"often": len(often), "found_often": len(set(often) & set(figures["found_ids"]))}
                lines.append(row(f"{detector}, {scene}", figures))
                total.update({key: figures[key] for key in (*COUNTED, "often", "found_often", "ms")})
            lines.append(row(f"**{detector}, all**", total | {"ms": total["ms"] / len(options.scene or SCENES)}))
    columns = (
        "", "precision", "recall", "of those detected often", "doubles", "misplaced", "named wrongly", "phantom",
        "relations right, strict", "labelled relations found", "ms an image",
    )  # fmt: skip
    print("| " + " | ".join(columns) + " |")
    print("| " + " | ".join("---" for _ in columns) + " |")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
