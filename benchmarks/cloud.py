"""Times CloudBuilder on VGA frames of a 7-Scenes or TUM RGB-D folder.

python benchmarks/cloud.py DATA/rgbd_7scenes
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from operators.cloud import CloudBuilder
from operators.sources import RgbdFolder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)

    source = RgbdFolder(path=arguments.folder, stop=arguments.frames)
    source.setup()
    statics = source.static_outputs()
    start = time.perf_counter()
    frames = list(source.stream())
    print(f"reading and decoding: {(time.perf_counter() - start) / len(frames) * 1e3:.1f} ms a frame")
    print("| stride | edge filter | points | median ms |\n| --- | --- | --- | --- |")
    for stride in (1, 2, 4):
        for edge_ratio in (0.0, 0.05):
            builder = CloudBuilder(stride=stride, edge_ratio=edge_ratio)
            seconds, points = [], []
            for frame in frames:
                start = time.perf_counter()
                made = builder.process(
                    frame["depth"],  # type: ignore[arg-type]
                    frame["image"],  # type: ignore[arg-type]
                    statics["depth_info"],  # type: ignore[arg-type]
                    statics["image_info"],  # type: ignore[arg-type]
                    statics["extrinsics"],  # type: ignore[arg-type]
                )
                seconds.append(time.perf_counter() - start)
                points.append(len(made["cloud"].points))  # type: ignore[attr-defined]
            edges = "on" if edge_ratio else "off"
            print(f"| {stride} | {edges} | {np.median(points):.0f} | {np.median(seconds) * 1e3:.1f} |")


if __name__ == "__main__":
    main()
