"""RGB-D odometry with faults in its frames: accuracy where the frames are valid, and when the map is found again.

    python benchmarks/odometry_faults.py                                     7-Scenes
    python benchmarks/odometry_faults.py --from 60,80,110 --fault missing    the faults so named, from other frames on
    python benchmarks/odometry_faults.py worlds office:823 corridor:824      gaps in drives through simulated worlds

One fault at a time, from each of some frames on. ATE is that of the poses as emitted, over the frames whose image or
depth is valid and changes, after SE(3) alignment; and that of those among them at which the odometry reports
tracking. *Tracked* is the share of these; *found again* after how many frames that follow the fault it does so first,
within 10 cm of the truth by the first pose: so in the map from before.

In simulated worlds, frames are missing: 52 gaps in each, of 1 to 8 s. A gap is *wrong* where a pose that is claimed in
the old map within the next second is 20 cm or 0.1 rad off, else *found* where one is claimed, else *lost*. *Seen
before* are those whose first frame shows, by the truth, at least half of what one view before the gap saw.
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
from odometry_gaps import WORLDS, table
from visual_odometry import REPOSITORY, read, score

from dataflow.messages.geometry import invert
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.tracker import RgbdOdometry
from operators.odometry.tracking import MEASURED

Frame = tuple[NDArray[np.uint8], NDArray[np.float32]]
BEGINS = (30, 100, 170)  # first frames with a fault
PERIOD = 1_000_000_000 // 30
NEAR = 0.1
DATA = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data") / "rgbd_7scenes"


@dataclass(frozen=True)
class Fault:
    """What becomes of so many frames: `spoilt` gives the frame in place of one (None: it does not come)."""

    frames: int
    spoilt: Callable[[Frame, Frame], Frame | None]


FAULTS = {
    "none": Fault(0, lambda last, now: now),
    "colour frozen for 1 s": Fault(30, lambda last, now: (last[0], now[1])),
    "depth frozen for 1 s": Fault(30, lambda last, now: (now[0], last[1])),
    "colour and depth frozen for 2 s": Fault(60, lambda last, now: last),
    "60 frames missing": Fault(60, lambda last, now: None),
    "colour and depth black for 60 frames": Fault(60, lambda last, now: (np.zeros_like(now[0]), np.zeros_like(now[1]))),
    "depth black for 60 frames": Fault(60, lambda last, now: (now[0], np.zeros_like(now[1]))),
    "left half of depth missing for 60 frames": Fault(60, lambda last, now: (now[0], half(now[1]))),
}


def half(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    found = depth.copy()
    found[:, : depth.shape[1] // 2] = 0
    return found


def shows(given: Frame, last: Frame) -> bool:
    """Returns whether an image or a depth image shows anything, and not what the last one did."""
    image = bool(given[0].any()) and not np.array_equal(given[0], last[0])
    return image or (bool(given[1].any()) and not np.array_equal(given[1], last[1]))


def run(frames: list[Frame], truth: list[Any], camera: RgbdCamera, fault: Fault, begins: int) -> dict[str, float]:
    """Returns the figures of one fault that begins at a frame."""
    odometry, ends = RgbdOdometry(camera, RgbdOdometryConfig()), begins + fault.frames
    estimate, reference, tracks, again = [], [], [], np.nan
    last: Frame = np.zeros_like(frames[0][0]), np.zeros_like(frames[0][1])
    for i, frame in enumerate(frames):
        given = fault.spoilt(frames[begins - 1], frame) if begins <= i < ends else frame
        if given is None:
            continue
        result = odometry.track(*given, i * PERIOD)
        tracking = result.status in MEASURED
        off = np.linalg.norm((invert(truth[0]) @ truth[i] - result.T_world_camera)[:3, 3])
        if i >= ends and np.isnan(again) and tracking and off < NEAR:
            again = i - ends
        if shows(given, last):
            estimate.append(result.T_world_camera)
            reference.append(truth[i])
            tracks.append(tracking)
        last = given
    tracked = [[pose for pose, yes in zip(poses, tracks, strict=True) if yes] for poses in (estimate, reference)]
    return {
        "ate_cm": score(estimate, reference, 30)["ate_cm"],
        "ate_tracked_cm": score(tracked[0], tracked[1], 30)["ate_cm"],
        "tracked_percent": 100 * float(np.mean(tracks)),
        "found_again_frames": float(again),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["recorded", "worlds"], nargs="?", default="recorded")
    parser.add_argument("worlds", nargs="*", default=list(WORLDS), help="KIND:SEED")
    parser.add_argument("--cache", type=Path, default=Path("out") / "visual_odometry", help="folder of rendered drives")
    parser.add_argument("--data", type=Path, default=DATA, help="a 7-Scenes folder (default: the project's data)")
    parser.add_argument(
        "--from", dest="begins", type=numbers, default=list(BEGINS), help="first frames with a fault: 60,80"
    )
    parser.add_argument("--fault", action="append", help="a part of a fault's name (default: every fault)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.what == "worlds":
        table(arguments.worlds, arguments.cache)
        return
    frames, truth = read(arguments.data)
    K_depth = np.loadtxt(arguments.data / "camera-intrinsics.txt")
    K_color = K_depth.copy()
    K_color[0, 0] = K_color[1, 1] = 525.0
    camera = RgbdCamera(K_color, K_depth)
    begins = [b for b in arguments.begins if 0 < b < len(frames)]
    chosen = {
        name: fault
        for name, fault in FAULTS.items()
        if not arguments.fault or any(part in name for part in arguments.fault)
    }
    rows = []
    if not arguments.json:
        print("| fault | from frame | ATE cm | ATE where tracked cm | tracked % | found again, frames |")
        print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, fault in chosen.items():
        for b in begins if fault.frames else begins[:1]:
            rows.append({"fault": name, "begins": b} | run(frames, truth, camera, fault, b))
            if not arguments.json:
                show(rows[-1])
    if arguments.json:
        print(json.dumps(rows, indent=1))


def show(row: dict[str, Any]) -> None:
    figures = " | ".join(f"{row[name]:.2f}" for name in ("ate_cm", "ate_tracked_cm"))
    figures += f" | {row['tracked_percent']:.1f} | {row['found_again_frames']:.0f}"
    print(f"| {row['fault']} | {row['begins'] if FAULTS[row['fault']].frames else ''} | {figures} |", flush=True)


def numbers(text: str) -> list[int]:
    """Returns the whole numbers of a list with commas."""
    return [int(part) for part in text.split(",")]


if __name__ == "__main__":
    main()
