"""The vertical from single views of real rooms, against the labels' own, carried to each view by the poses.

    python benchmarks/verticals.py DATA

DATA is the folder of shared data with its three labelled scenes. Each view is judged alone, without an
accelerometer, as CameraMount judges the first: it decides, or leaves it to another view.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from operators.cloud.vertical import find_vertical, held

Array = NDArray[np.float64]
SCENES = {"seven_0_249": ("rgbd_7scenes", 1000.0), "fr1_rpy": ("scenes/fr1_rpy", 5000.0)}
SCENES["cup_table"] = ("scenes/cup_table", 5000.0)
"""Folder of the frames, and the units of a metre in their depth."""
WRONG = 10.0  # degrees


def view(file: Path, K: Array, unit: float) -> NDArray[np.float32]:
    """Returns the points (N, 3), metres, of every second pixel of a depth image."""
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert depth is not None, file
    z = depth[::2, ::2] / unit
    v, u = np.nonzero((z > 0) & (z < 20))
    d = z[v, u]
    return np.column_stack([(2 * u - K[0, 2]) * d / K[0, 0], (2 * v - K[1, 2]) * d / K[1, 1], d]).astype(np.float32)


def row(data: Path, scene: str) -> str:
    """Returns a line of the table: views, those that decide, their errors, and those that decide wrongly."""
    labels = json.loads((data / "scenes" / f"{scene}.json").read_text())
    folder, unit = SCENES[scene]
    files = sorted((data / folder).glob("**/*depth*.png" if "7scenes" in folder else "depth/*.png"))
    up = np.array(labels["up_in_first_camera"])
    errors, undecided = [], 0
    for frame, *pose in labels["poses"]:
        if frame >= len(files):
            continue
        found = find_vertical(view(files[frame], np.array(labels["K_depth"]), unit), *held())
        if found is None or found.doubt > 1:
            undecided += 1
            continue
        true = Rotation.from_quat(pose[4:]).inv().apply(up)
        errors.append(float(np.degrees(np.arccos(np.clip(found.up @ true, -1, 1)))))
    figures = f"{np.median(errors):.1f}° | {max(errors):.1f}°" if errors else " | "
    wrong = sum(error > WRONG for error in errors)
    return f"| {scene} | {len(errors) + undecided} | {len(errors)} | {figures} | {wrong} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    print(f"| scene | views | decide | median error | largest | by more than {WRONG:.0f}° |")
    print("| --- | --- | --- | --- | --- | --- |")
    for scene in SCENES:
        print(row(data, scene), flush=True)


if __name__ == "__main__":
    main()
