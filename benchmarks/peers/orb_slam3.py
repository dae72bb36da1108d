"""ORB-SLAM3 on a 7-Scenes folder: how far its poses are from the truth as it gives them, and its time a frame.

    VENV/bin/python benchmarks/peers/orb_slam3.py DATA/rgbd_7scenes --words DATA/coco128 DATA/camvid [--runs 5]

VENV is a virtual environment with pyorbslam3 (GPL: the project imports nothing of it), opencv-python-headless and
numpy. Its vocabulary, which no package brings, is learned from other images, those below the folders `--words`: ORB
descriptors divided by k-medians of their bits, ten ways four times over, weighted by how few images have a word.

Depth is laid on the colour image: both cameras of 7-Scenes have one centre here, and one focal length unless another
is given for colour; with 525, by which our odometry works, ORB-SLAM3 is worse. The poses are scored as they were
emitted, against all frames of the truth, after SE(3) alignment. ORB-SLAM3 works in three threads, so it gives other
figures each time; milliseconds are those of a call, median. A frame without a pose has its last one, and is counted.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
WAYS, DEPTH, FEATURES, OF_AN_IMAGE = 10, 4, 1000, 300
SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {f}
Camera1.fy: {f}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def learn_words(folders: list[Path], out: Path) -> int:
    """Writes a vocabulary in ORB-SLAM3's text format, learned from the images below some folders; returns its words."""
    files = sorted(f for folder in folders for kind in ("*.jpg", "*.png") for f in folder.rglob(kind))
    orb = cv2.ORB.create(OF_AN_IMAGE)
    rows, images = [], []
    for number, file in enumerate(files):
        found: Any = orb.detectAndCompute(loaded(file, cv2.IMREAD_GRAYSCALE), None)[1]
        if found is not None:
            rows.append(np.unpackbits(found, axis=1))
            images.append(np.full(len(found), number))
    bits, image = np.concatenate(rows).astype(np.float32), np.concatenate(images)
    nodes: list[tuple[int, bool, NDArray[np.uint8], float]] = []
    many = len(np.unique(image))

    def divide(chosen: NDArray[np.intp], parent: int, level: int) -> None:
        ways = min(WAYS, len(chosen))
        cv2.setRNGSeed(0)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 8, 1e-3)
        nothing: Any = None
        _, label, centres = cv2.kmeans(bits[chosen], ways, nothing, stop, 1, cv2.KMEANS_PP_CENTERS)
        for way in range(ways):
            mine = chosen[np.asarray(label)[:, 0] == way]
            if not len(mine):
                continue
            leaf = level == DEPTH or len(mine) < 2 * WAYS
            weight = float(np.log(many / len(np.unique(image[mine])))) if leaf else 0.0
            nodes.append((parent, leaf, (np.asarray(centres)[way] > 0.5).astype(np.uint8), max(weight, 1e-3)))
            if not leaf:
                divide(mine, len(nodes), level + 1)

    divide(np.arange(len(bits)), 0, 1)
    with out.open("w") as written:
        written.write(f"{WAYS} {DEPTH} 0 0\n")
        for parent, leaf, centre, weight in nodes:
            numbers = " ".join(str(byte) for byte in np.packbits(centre))
            written.write(f"{parent} {int(leaf)} {numbers} {weight if leaf else 0}\n")
    return sum(leaf for _, leaf, _, _ in nodes)


def loaded(file: Path, how: int) -> NDArray[Any]:
    """Returns an image as it is in its file. Raises SystemExit where that is none."""
    image = cv2.imread(str(file), how)
    if image is None:
        raise SystemExit(f"{file} is no image")
    return np.asarray(image)


def read(folder: Path, focal: float | None) -> tuple[list[tuple[Any, Any]], list[Matrix], Matrix]:
    """Returns colour (H, W, 3) with depth in metres laid on it, the true poses, and K of the colour camera."""
    K_depth = np.loadtxt(folder / "camera-intrinsics.txt")
    focal = K_depth[0, 0] if focal is None else focal
    frames, truth = [], []
    for file in sorted(folder.rglob("*.color.*")):
        base = file.name.split(".")[0]
        image = loaded(file, cv2.IMREAD_COLOR_RGB)
        depth = loaded(file.with_name(f"{base}.depth.png"), cv2.IMREAD_UNCHANGED)
        metres = np.where((depth == 0) | (depth == 65535), 0, depth).astype(np.float32) / 1000
        v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
        cx, cy, zoom = K_depth[0, 2], K_depth[1, 2], K_depth[0, 0] / focal
        x, y = ((u - cx) * zoom + cx).astype(np.float32), ((v - cy) * zoom + cy).astype(np.float32)
        frames.append((image, cv2.remap(metres, x, y, cv2.INTER_NEAREST)))
        truth.append(np.loadtxt(file.with_name(f"{base}.pose.txt")))
    K = K_depth.copy()
    K[0, 0] = K[1, 1] = focal
    return frames, truth, K


def ate(estimate: list[Matrix], truth: list[Matrix]) -> float:
    """Returns the RMSE in metres of positions after the rigid motion that fits them best."""
    a, b = (np.array([T[:3, 3] for T in poses]) for poses in (estimate, truth))
    U, _, Vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return float(np.sqrt((((a - a.mean(0)) @ R.T + b.mean(0) - b) ** 2).sum(1).mean()))


def run(words: Path, settings: Path, frames: list[tuple[Any, Any]], truth: list[Matrix]) -> dict[str, float]:
    import pyorbslam3

    poses, took, without = [np.eye(4)], [], 0
    with pyorbslam3.Slam(words, settings, pyorbslam3.Sensor.RGBD) as slam:
        for number, (image, depth) in enumerate(frames):
            began = time.perf_counter()
            result = slam.track_rgbd(image, depth, number / 30)
            took.append(1e3 * (time.perf_counter() - began))
            without += not result.ok
            poses.append(np.asarray(result.pose_wc, np.float64) if result.ok else poses[-1])
    return {"ate_cm": 1e2 * ate(poses[1:], truth), "ms": statistics.median(took), "without_pose": without}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--words", type=Path, nargs="+", required=True, help="folders of images for the vocabulary")
    parser.add_argument("--color-focal", type=float, help="focal length of the colour camera, px (default: depth's)")
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    frames, truth, K = read(arguments.data, arguments.color_focal)
    height, width = frames[0][0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        words, settings = Path(folder) / "words.txt", Path(folder) / "settings.yaml"
        count = learn_words(arguments.words, words)
        settings.write_text(
            SETTINGS.format(f=K[0, 0], cx=K[0, 2], cy=K[1, 2], width=width, height=height, features=FEATURES)
        )
        results = [run(words, settings, frames, truth) for _ in range(arguments.runs)]
    print(json.dumps({"words": count, "frames": len(frames), "runs": results}, indent=1))
    os._exit(0)  # its threads do not end


if __name__ == "__main__":
    main()
