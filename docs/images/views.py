"""Takes the pictures of graphs in the viewer: `python docs/images/views.py [NAME ...]`.

Needs what draws a window without a display: xvfb-run and a Vulkan driver for the CPU (Debian: xvfb,
mesa-vulkan-drivers, libxkbcommon-x11-0). Graphs that read data of others are shown by their simulated relatives, since
pictures of that data must not be passed on.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent.parent
DATA = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data")
SIZE = (1600, 1000)

VIEWS: dict[str, tuple[str, ...]] = {
    "dead_reckoning": ("run", "graphs/dead_reckoning.yaml"),
    "depth": ("run", "graphs/depth.yaml"),
    "fusion": ("run", "graphs/fusion.yaml"),
    "lidar": ("run", "graphs/simulated_lidar.yaml"),
    "mono": ("run", "graphs/mono.yaml"),
    "mono_depth": (
        "run",
        "graphs/mono_depth.yaml",
        "--set",
        f"model={DATA / 'models' / 'tcmonodepth_small_192x320.onnx'}",
    ),
    "perception": ("replay", "recordings/demo.mcap", "--graph", "graphs/perception.yaml"),
    "slam": ("run", "graphs/slam.yaml", "--set", "duration=26s"),
    "stereo": ("run", "graphs/simulated_stereo.yaml"),
}
"""The arguments of `dataflow` by the picture's name."""

LATER = {"fusion": 39, "slam": 22}
"""Seconds after the start of which a picture is, where there is little to be seen at first."""


def picture(name: str, folder: Path) -> Path:
    """Runs a graph, renders what the viewer shows of it, and writes NAME.png beside this file."""
    shown, large = folder / f"{name}.rrd", folder / f"{name}.png"
    programs = Path(sys.executable).parent
    command = [sys.executable, "-m", "dataflow.cli.main"]
    if name in LATER:
        recorded = folder / f"{name}.mcap"
        run = [*command, *VIEWS[name], "--record", str(recorded), "--quiet"]
        subprocess.run(run, cwd=REPOSITORY, check=True)
        show = [*command, "view", str(recorded), "--to", str(shown), "--start", str(LATER[name])]
        subprocess.run(show, cwd=REPOSITORY, check=True)
        recorded.unlink()
    else:
        subprocess.run([*command, *VIEWS[name], "--view", str(shown), "--quiet"], cwd=REPOSITORY, check=True)
    size = f"{SIZE[0]}x{SIZE[1]}"
    # The screen is so large that the pointer, in its middle, is not on the window.
    subprocess.run(
        ["xvfb-run", "-a", "-s", "-screen 0 4800x3000x24", str(programs / "rerun"), "--screenshot-to", str(large),
         "--window-size", size, "--bind", "127.0.0.1", "--new", str(shown)],
        check=True, capture_output=True, timeout=180,
    )  # fmt: skip
    pixels = cv2.imread(str(large))
    if pixels is None:
        raise SystemExit(f"the viewer wrote no picture of {name}")
    file = HERE / f"{name}.png"
    cv2.imwrite(str(file), cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return file


def main() -> None:
    names = sys.argv[1:] or list(VIEWS)
    unknown = [name for name in names if name not in VIEWS]
    if unknown:
        raise SystemExit(f"no view {unknown[0]!r}; there are {', '.join(VIEWS)}")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            print(picture(name, Path(folder)))


if __name__ == "__main__":
    main()
