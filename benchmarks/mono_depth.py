"""Error of monocular depth on RGB-D frames, after alignment to the true depth and after alignment to a few depths.

python benchmarks/mono_depth.py
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages import DepthImage  # noqa: E402
from dataflow.testing import play  # noqa: E402
from operators.depth import MonoDepth  # noqa: E402
from operators.evaluation.depth_metrics import depth_errors  # noqa: E402
from operators.geometry.pinhole import project, unproject  # noqa: E402
from operators.sources import RgbdFolder  # noqa: E402

Depth = NDArray[np.float32]
DATA = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data")


def registered(depth: Depth, K_depth: Any, K_color: Any, size: tuple[int, int]) -> Depth:
    """The depth image seen by the colour camera at the same place; of what falls on one pixel the nearest."""
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    there = np.rint(project(unproject(np.column_stack([u, v]).astype(np.float64), K_depth) * z[:, None], K_color))
    columns, rows = there.astype(np.int64).T
    inside = (columns >= 0) & (rows >= 0) & (columns < size[0]) & (rows < size[1])
    out = np.full(size[::-1], np.inf, np.float32)
    np.minimum.at(out, (rows[inside], columns[inside]), z[inside].astype(np.float32))
    return np.where(np.isfinite(out), out, 0).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, default=DATA / "models" / "tcmonodepth_small_192x320.onnx")
    parser.add_argument("--data", type=Path, default=DATA / "rgbd_7scenes", help="a folder of RGB-D frames")
    parser.add_argument("--every", type=int, default=10, help="frames between two that are scored")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    source = RgbdFolder(path=str(arguments.data))
    source.setup()
    statics: Any = source.static_outputs()
    rows: dict[str, list[list[float]]] = {}
    spent, missing = list[float](), dict[str, int]()
    for k, step in enumerate(source.stream()):
        given: Any = step
        if k % arguments.every:
            continue
        image = given["image"]
        true = np.where((given["depth"].data > 0.3) & (given["depth"].data < 6), given["depth"].data, 0)
        size = (image.width, image.height)
        truth = registered(true.astype(np.float32), statics["depth_info"].K, statics["image_info"].K, size)
        rng = np.random.default_rng(k)
        known = np.flatnonzero(truth)
        few = np.zeros_like(truth)
        chosen = rng.choice(known, 100, replace=False)
        few.ravel()[chosen] = truth.ravel()[chosen]
        wrong = few.copy()
        wrong.ravel()[chosen[:30]] *= rng.uniform(1.5, 3, 30).astype(np.float32)
        cases = {
            "all true depths, scale and shift": ("scale_and_shift", truth),
            "all true depths, scale": ("scale", truth),
            "100 true depths, scale and shift": ("scale_and_shift", few),
            "100 depths, 30 of them 1.5-3 times too far": ("scale_and_shift", wrong),
        }
        for name, (align, sparse) in cases.items():
            mono = MonoDepth(model=str(arguments.model), align=align, max_range=100.0)
            given_depth = DepthImage(stamp=image.stamp, frame=image.frame, data=sparse)
            before = time.process_time()
            played = play(mono, {"image": [image], "sparse": [given_depth]}, paranoid=False)
            spent.append(1e3 * (time.process_time() - before))
            if not played["depth"]:
                missing[name] = missing.get(name, 0) + 1
                continue
            found: Any = played["depth"][0]
            judged = truth.copy()
            if sparse is not truth:
                judged.ravel()[chosen] = 0
            e = depth_errors(found.data, judged)
            rows.setdefault(name, []).append([e.relative, e.middle, e.rmse, e.near, e.measured / e.judged])
        middle = np.full_like(truth, np.median(truth.ravel()[known]))
        e = depth_errors(middle, truth)
        rows.setdefault("one depth for all pixels: the median", []).append([e.relative, e.middle, e.rmse, e.near, 1])
    report(rows, missing, spent)


def report(rows: dict[str, list[list[float]]], missing: dict[str, int], spent: list[float]) -> None:
    titles = (
        "aligned to", "frames", "no scale", "mean error", "worst", "median", "RMSE m", "within 25 %", "measured"
    )  # fmt: skip
    print("| " + " | ".join(titles) + " |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, row in rows.items():
        relative, middle_error, rmse, near, share = np.mean(row, axis=0)
        worst = np.max(row, axis=0)[0]
        print(
            f"| {name} | {len(row)} | {missing.get(name, 0)} | {relative:.3f} | {worst:.3f} | {middle_error:.3f} "
            f"| {rmse:.3f} | {near:.3f} | {share:.3f} |"
        )
    print(f"\nCPU of one image and of loading the model, median: {np.median(spent):.0f} ms")


if __name__ == "__main__":
    main()
