"""RGB-D odometry on a 7-Scenes folder with faults in its frames: accuracy where the frames are valid.

    python benchmarks/odometry_faults.py
    python benchmarks/odometry_faults.py --data FOLDER --begins 60 120 --json

One fault at a time, from each of some frames on. ATE is that of the poses as emitted, over the frames whose image or
depth is valid and changes, after SE(3) alignment. *Tracked* is the share of those frames at which the odometry says
that it tracks; *found again* after how many frames that follow the fault it does so first, within 10 cm of the truth
by the first pose: so in the map from before.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from visual_odometry import REPOSITORY, read, score

from dataflow.messages.geometry import invert
from operators.odometry.camera import RgbdCamera
from operators.odometry.rgbd_odometry import RgbdOdometry
from operators.odometry.settings import RgbdOdometryConfig
from operators.odometry.tracking import MEASURED

Frame = tuple[NDArray[np.uint8], NDArray[np.float32]]
BEGINS = (30, 100, 170)  # first frames with a fault
PERIOD = 1_000_000_000 // 30
NEAR = 0.1
DATA = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "rgbd_7scenes"


@dataclass(frozen=True)
class Fault:
    """What becomes of so many frames: `spoilt` gives the frame in place of one (None: it does not come), `blind` that
    neither image nor depth is of use then."""

    frames: int
    spoilt: Callable[[Frame, Frame], Frame | None]
    blind: bool


FAULTS = {
    "none": Fault(0, lambda last, now: now, False),
    "colour frozen for 1 s": Fault(30, lambda last, now: (last[0], now[1]), False),
    "depth frozen for 1 s": Fault(30, lambda last, now: (now[0], last[1]), False),
    "colour and depth frozen for 2 s": Fault(60, lambda last, now: last, True),
    "60 frames missing": Fault(60, lambda last, now: None, True),
    "colour and depth black for 60 frames": Fault(
        60, lambda last, now: (np.zeros_like(now[0]), np.zeros_like(now[1])), True
    ),
    "depth black for 60 frames": Fault(60, lambda last, now: (now[0], np.zeros_like(now[1])), False),
    "left half of depth missing for 60 frames": Fault(60, lambda last, now: (now[0], half(now[1])), False),
}


def half(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    found = depth.copy()
    found[:, : depth.shape[1] // 2] = 0
    return found


def run(frames: list[Frame], truth: list[Any], camera: RgbdCamera, fault: Fault, begins: int) -> dict[str, float]:
    """Returns the figures of one fault that begins at a frame."""
    odometry, ends = RgbdOdometry(camera, RgbdOdometryConfig()), begins + fault.frames
    estimate, reference, tracks, again = [], [], [], np.nan
    for i, frame in enumerate(frames):
        within = begins <= i < ends
        given = fault.spoilt(frames[begins - 1], frame) if within else frame
        if given is None:
            continue
        result = odometry.track(*given, i * PERIOD)
        tracking = result.status in MEASURED
        off = np.linalg.norm((invert(truth[0]) @ truth[i] - result.T_world_camera)[:3, 3])
        if i >= ends and np.isnan(again) and tracking and off < NEAR:
            again = i - ends
        if not (within and fault.blind):
            estimate.append(result.T_world_camera)
            reference.append(truth[i])
            tracks.append(tracking)
    return {
        "ate_cm": score(estimate, reference, 30)["ate_cm"],
        "tracked_percent": 100 * float(np.mean(tracks)),
        "found_again_frames": float(again),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="a 7-Scenes folder (default: the project's data)")
    parser.add_argument("--begins", type=int, nargs="*", default=list(BEGINS), help="first frames with a fault")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frames, truth = read(arguments.data)
    K_depth = np.loadtxt(arguments.data / "camera-intrinsics.txt")
    K_color = K_depth.copy()
    K_color[0, 0] = K_color[1, 1] = 525.0
    camera = RgbdCamera(K_color, K_depth)
    begins = [b for b in arguments.begins if 0 < b < len(frames)]
    rows = [
        {"fault": name, "begins": b} | run(frames, truth, camera, fault, b)
        for name, fault in FAULTS.items()
        for b in (begins if fault.frames else begins[:1])
    ]
    if arguments.json:
        print(json.dumps(rows, indent=1))
        return
    print("| fault | from frame | ATE cm | tracked % | found again, frames |\n| --- | ---: | ---: | ---: | ---: |")
    for row in rows:
        figures = f"{row['ate_cm']:.2f} | {row['tracked_percent']:.1f} | {row['found_again_frames']:.0f}"
        print(f"| {row['fault']} | {row['begins'] if FAULTS[row['fault']].frames else ''} | {figures} |")


if __name__ == "__main__":
    main()
