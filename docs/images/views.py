"""Takes the pictures of graphs in the viewer: `python docs/images/views.py [NAME ...]`.

Needs what draws a window without a display: xvfb-run and a Vulkan driver for the CPU (Debian: xvfb,
mesa-vulkan-drivers, libxkbcommon-x11-0). Graphs that read data of others are shown by their simulated relatives, since
pictures of that data must not be passed on.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image
from rerun.experimental import ViewerClient

from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.view import Save, ViewerSink, ViewOptions, from_recording
from dataflow.view.scene import TIMELINE

Picture = npt.NDArray[np.uint8]

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent.parent
DATA = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data")
PROGRAMS = Path(sys.executable).parent
SETTLED = 4.0
"""Seconds that the viewer may take to draw a moment, without a GPU."""
WITHIN = 900
"""Seconds for a file or a picture, on a busy machine without a GPU."""
MOMENTS = (0.0, 0.02, 0.5, 1.0)
"""Shares of a file's length at which no view may report an error."""
SIZE = (1200, 750)
DRAWN = (1600, 1000)  # the window that is made smaller
BYTES = 150_000
"""The largest picture: one that is larger is given fewer colours."""

VIEWS: dict[str, tuple[str, ...]] = {
    "cloud": ("replay", "recordings/demo.mcap", "--graph", "graphs/cloud.yaml"),
    "dead_reckoning": ("run", "graphs/dead_reckoning.yaml"),
    "depth": ("run", "graphs/depth.yaml"),
    "fusion": ("run", "graphs/fusion.yaml", "--set", "duration=30s"),
    "landmarks": ("run", "graphs/landmarks.yaml", "--set", "duration=30s"),
    "lidar": ("run", "graphs/simulated_lidar.yaml"),
    "localize": ("run", "graphs/localize.yaml", "--set", "duration=18s"),
    "mapping": ("run", "graphs/mapping.yaml", "--set", "duration=20s"),
    "mono": ("run", "graphs/mono.yaml"),
    "mono_depth": (
        "run",
        "graphs/mono_depth.yaml",
        "--set",
        f"model={DATA / 'models' / 'tcmonodepth_small_192x320.onnx'}",
    ),
    "orientation": ("run", "graphs/orientation.yaml", "--set", "duration=12s"),
    "places": ("run", "graphs/places.yaml", "--set", "duration=16s"),
    "preprocessing": ("run", "graphs/preprocessing.yaml", "--set", "duration=6s"),
    "redundant": ("run", "graphs/redundant.yaml", "--set", "duration=18s"),
    "registration": ("run", "graphs/registration.yaml", "--set", "duration=12s"),
    "slam": ("run", "graphs/slam.yaml", "--set", "duration=26s"),
    "slam_lidar": ("run", "graphs/slam_lidar.yaml", "--set", "duration=26s"),
    "stereo": ("run", "graphs/simulated_stereo.yaml"),
}
"""The arguments of `dataflow` by the picture's name."""

LATER = {
    "cloud": 9.2,
    "fusion": 29,
    "landmarks": 29,
    "localize": 17,
    "mapping": 19,
    "mono": 11,
    "orientation": 11,
    "places": 15,
    "preprocessing": 2,
    "redundant": 17,
    "registration": 11,
    "slam": 25,
    "slam_lidar": 25,
}
"""Seconds after the start of which a picture is, where it is not of the end."""

GROWN = "demo"
"""The picture of the whole perception."""

MOMENT = 9.2
"""Seconds after its start at which it is taken: a person walks to a chair."""

WIDE, HIGH = 4 * DRAWN[0] + 200, 4 * DRAWN[1] + 200
"""The screen is so large that the pointer, in its middle, is not on the window: for a picture, the viewer makes its
window twice as wide and high in pixels as it is asked for."""


def rendered(shown: Path) -> Picture:
    """Returns a screenshot of the viewer, taken a moment after it opened a file."""
    large = shown.with_suffix(".png")
    subprocess.run(
        ["xvfb-run", "-a", "-s", f"-screen 0 {WIDE}x{HIGH}x24", str(PROGRAMS / "rerun"), "--screenshot-to", str(large),
         "--window-size", f"{DRAWN[0]}x{DRAWN[1]}", "--bind", "127.0.0.1", "--new", str(shown)],
        check=True, capture_output=True, timeout=WITHIN,
    )  # fmt: skip
    pixels = cv2.imread(str(large))
    if pixels is None:
        raise SystemExit(f"the viewer wrote no picture of {shown.name}")
    return np.asarray(cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def complaints(shown: Path, moments: Iterable[float]) -> list[str]:
    """Returns the errors that the viewer reports in views of a file at these shares of its length."""
    found = dict[str, None]()
    viewer = ViewerClient.spawn(headless=True, port=free_port(), executable_path=str(PROGRAMS / "rerun"))
    try:
        viewer.open([str(shown)])
        (timeline,) = (t for r in viewer.get_state().recordings for t in r.timelines if t.name == TIMELINE)
        for moment in moments:
            at = timeline.start + round(moment * (timeline.end - timeline.start))
            viewer.set_time(TIMELINE, timestamp=np.datetime64(at, "ns"), play_state="paused")
            time.sleep(SETTLED)
            for view in viewer.get_state().views:
                found |= {f"{view.name}: {r.summary}": None for r in view.reports if r.severity == "error"}
    finally:
        viewer.quit()
    return list(found)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def perceived(folder: Path) -> tuple[Path, Path]:
    """Runs the perception on the bundled recording; its graph and a recording of all that it shows, in the folder."""
    shutil.copytree(REPOSITORY / "graphs", folder / "graphs")
    graph, recorded = folder / "graphs" / "perception.yaml", folder / "perception.mcap"
    text = re.sub("^record:.*\n", "", graph.read_text(encoding="utf-8"), flags=re.MULTILINE)
    graph.write_text(text, encoding="utf-8")
    words = ["replay", "recordings/demo.mcap", "--graph", str(graph), "--record", str(recorded), "--quiet"]
    subprocess.run([sys.executable, "-m", "dataflow.cli.main", *words], cwd=REPOSITORY, check=True)
    return graph, recorded


def at(seconds: float | None, graph: Path, recorded: Path, file: Path) -> None:
    """Writes what the viewer shows after so many seconds, or at the end, with as many points as a live one draws."""
    made = load_graph(graph)
    with Recording(recorded) as recording:
        begins = min(i.first for i in recording.streams.values() if i.first is not None and not i.static)
        with ViewerSink(Save(file, at_end=True), options=ViewOptions()) as sink:
            streams = [name for name, info in recording.streams.items() if info.message_type is not None]
            end = None if seconds is None else begins + round(seconds * 1e9)
            from_recording(recording, sink, streams, end=end, graph=made)
            if not sink.close(WITHIN):
                raise SystemExit(f"{file.name} was not written within {WITHIN} s")


def grown(folder: Path) -> Path:
    """The picture of the whole perception."""
    graph, recorded = perceived(folder)
    at(MOMENT, graph, recorded, folder / "moment.rrd")
    return written(rendered(folder / "moment.rrd"), f"{GROWN}.png")


def written(pixels: Picture, name: str) -> Path:
    """Writes a picture beside this file with as many colours as it may have."""
    file, picture = HERE / name, Image.fromarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
    for colors in (256, 192, 128, 96, 64):
        few = picture.quantize(colors, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        few.save(file, optimize=True)
        if file.stat().st_size <= BYTES:
            break
    return file


def picture(name: str, folder: Path) -> Path:
    """Runs a graph, renders what the viewer shows of it, and writes NAME.png beside this file."""
    shown, recorded = folder / f"{name}.rrd", folder / f"{name}.mcap"
    command = [sys.executable, "-m", "dataflow.cli.main", *VIEWS[name], "--quiet", "--record", str(recorded)]
    subprocess.run(command, cwd=REPOSITORY, check=True)
    (graph,) = (word for word in VIEWS[name] if word.endswith(".yaml"))
    at(LATER.get(name), REPOSITORY / graph, recorded, shown)
    recorded.unlink()
    for complaint in complaints(shown, MOMENTS):
        print(f"{name}: the viewer reports an error: {complaint}", file=sys.stderr)
    return written(rendered(shown), f"{name}.png")


def main() -> None:
    known = [GROWN, *VIEWS]
    names = sys.argv[1:] or known
    unknown = [name for name in names if name not in known]
    if unknown:
        raise SystemExit(f"no view {unknown[0]!r}; there are {', '.join(known)}")
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            print(grown(Path(folder)) if name == GROWN else picture(name, Path(folder)))


if __name__ == "__main__":
    main()
