"""The recorder: what recording costs the graph beside it, and what it costs itself.

    python benchmarks/recorder.py
    python benchmarks/recorder.py --rounds 5 --seconds 20 --only camera

`roundtrip`: round trips of a VGA colour image's bytes between two processes (benchmarks/peers/roundtrip.yaml), with all
streams recorded and without, in turns. `camera`: a live run that records raw VGA colour and depth at 30 Hz, the frames
of recordings/demo.mcap enlarged; the CPU time of the recorder's process, taken from the operating system between the
first frames and the last, as a share of one core; in turns with a bare MCAP writer (the mcap package, lz4, chunks of
1 MiB) that is given the same images as the same protobufs, at once.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import CompressionType, Writer

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE), str(HERE / "peers")]

from roundtrip import WARM_UP, ours  # noqa: E402

from dataflow.graph import load_graph  # noqa: E402
from dataflow.recording import Recording  # noqa: E402
from dataflow.supervision.plan import RECORDER  # noqa: E402
from dataflow.supervision.run import run  # noqa: E402
from operators.codec import DepthDecoder, ImageDecoder  # noqa: E402

VGA_BYTES = 921_600
FRAMES = 30
RATE = 30.0
COLOR_NOISE = 1.5
"""Levels of 255, one sigma."""
DEPTH_NOISE = 0.002
"""Share of the distance, one sigma; distances are in whole millimetres."""
SETTLED = 1.0
"""Seconds after the first sign of the recorder before its CPU time counts."""

Figures = dict[str, float]


def roundtrip(count: int, folder: Path) -> Figures:
    """Round trips in µs without recording and with it, and the ratios to the unrecorded median."""
    plain = ours(HERE.parent)(VGA_BYTES, count)[WARM_UP:]
    trip = folder / "trip.mcap"
    recorded = ours(HERE.parent, record=trip)(VGA_BYTES, count)[WARM_UP:]
    with Recording(trip) as recording:
        assert recording.streams["roundtrip/ping/array"].count == count
    trip.unlink()
    half = statistics.median(plain)
    figures = {}
    for name, took in (("unrecorded", plain), ("recorded", recorded)):
        p99 = float(np.quantile(took, 0.99))
        figures[f"{name}: p50, µs"], figures[f"{name}: p99, µs"] = statistics.median(took), p99
    return figures | {
        "recorded p50 / unrecorded p50": figures["recorded: p50, µs"] / half,
        "recorded p99 / unrecorded p50": figures["recorded: p99, µs"] / half,
    }


def frames(file: Path) -> None:
    """Decodes frames of the demo recording, doubles their sides, adds a sensor's noise, and stores them."""
    noise = np.random.default_rng(7)
    graph = load_graph(HERE.parent / "graphs" / "simulated_robot.yaml")
    decoders: dict[str, Any] = {"robot1/robot/image_jpeg": ImageDecoder(), "robot1/robot/depth_png": DepthDecoder()}
    assert set(decoders) <= set(graph.streams)
    found: dict[str, list[Any]] = {stream: [] for stream in decoders}
    with Recording(HERE.parent / "recordings" / "demo.mcap") as recording:
        for stream, decoder in decoders.items():
            for _, recorded in zip(range(FRAMES), recording.messages([stream]), strict=False):
                made: Any = decoder.decode(recorded.message)
                data = made.data
                found[stream].append(data.repeat(2, axis=0).repeat(2, axis=1))
    color, depth = (np.stack(each) for each in found.values())
    noisy = np.rint(color + noise.normal(0, COLOR_NOISE, color.shape)).clip(0, 255).astype(np.uint8)
    rough = np.rint(1000 * depth * noise.normal(1, DEPTH_NOISE, depth.shape)) / 1000
    np.savez(file, color=noisy, depth=rough.astype(np.float32))


class ProcessClock:
    """Watches the CPU time of a child process of this one, by the name that it shows."""

    def __init__(self, name: str) -> None:
        self._name, self._over = name, threading.Event()
        self._seen: list[tuple[float, float]] = []
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> ProcessClock:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def share(self) -> float:
        """CPU seconds a second, from when it had settled to when it was last seen."""
        settled = [each for each in self._seen if each[0] >= self._seen[0][0] + SETTLED]
        (began, before), (ended, after) = settled[0], settled[-1]
        return (after - before) / (ended - began)

    def _watch(self) -> None:
        while not self._over.wait(0.1):
            for child in psutil.Process().children(recursive=True):
                try:
                    used = child.cpu_times() if child.name() == self._name else None
                except psutil.NoSuchProcess:
                    continue
                if used is not None:
                    self._seen.append((time.monotonic(), used.user + used.system))


def recorder(images: Path, seconds: float, compression: str, folder: Path) -> Figures:
    """Records a camera in a live run."""
    count = int(seconds * RATE)
    camera = {"use": "recorder_operators:Camera", "params": {"file": str(images), "count": count}}
    graph = folder / "camera.yaml"
    graph.write_text(json.dumps({"graph": "camera", "operators": {"camera": camera}}))  # JSON is YAML
    file = folder / "camera.mcap"
    with ProcessClock(RECORDER) as clock:
        run(load_graph(graph, live=True), live=True, record=file, overwrite=True, compression=compression)
    with Recording(file) as recording:
        kept = sum(recording.streams[f"camera/camera/{port}"].count for port in ("image", "depth"))
    return {"CPU, % of a core": 100 * clock.share(), "lost": 2 * count - kept, "MB": file.stat().st_size / 1e6}


def bare(images: Path, seconds: float, folder: Path) -> Figures:
    """Writes the same images with the mcap package alone."""
    with np.load(images) as loaded:
        color, depth = loaded["color"], loaded["depth"]
    file = folder / "bare.mcap"
    count = int(seconds * RATE)
    began = time.process_time()
    with file.open("wb") as opened:
        writer: Any = Writer(opened, compression=CompressionType.LZ4)
        writer.start()
        channels = [writer.register_channel(topic, "protobuf", 0) for topic in ("image", "depth")]
        for k in range(count):
            for channel, data in zip(channels, (color[k % len(color)], depth[k % len(depth)]), strict=True):
                height, width = data.shape[:2]
                proto = RawImage(frame_id="camera", width=width, height=height, data=data.tobytes())
                proto.step = data.strides[0]
                proto.encoding = "rgb8" if data.ndim == 3 else "32FC1"
                writer.add_message(channel, log_time=k, publish_time=k, data=proto.SerializeToString())
        writer.finish()
    return {
        "CPU, % of a core": 100 * (time.process_time() - began) / seconds,
        "lost": 0,
        "MB": file.stat().st_size / 1e6,
    }


def table(rounds: Mapping[str, list[Figures]]) -> str:
    """The median of each figure over the rounds, with the smallest and the largest, as Markdown."""
    names = list(next(iter(rounds.values()))[0])
    lines = ["| | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for who, figures in rounds.items():
        cells = []
        for name in names:
            values = [each[name] for each in figures]
            cells.append(f"{statistics.median(values):,.4g} ({min(values):,.4g} - {max(values):,.4g})")
        lines.append(f"| {who} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--count", type=int, default=300, help="round trips of a round")
    parser.add_argument("--seconds", type=float, default=10.0, help="of the camera, in each round")
    parser.add_argument("--only", default="roundtrip,camera")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        contests: dict[str, dict[str, Callable[[], Figures]]] = {
            "roundtrip": {"VGA there, 8 bytes back": lambda: roundtrip(arguments.count, folder)}
        }
        if "camera" in arguments.only:
            frames(images := folder / "frames.npz")
            contests["camera"] = {
                "recorder, zstd": lambda: recorder(images, arguments.seconds, "zstd", folder),
                "recorder, lz4": lambda: recorder(images, arguments.seconds, "lz4", folder),
                "bare MCAP writer, lz4": lambda: bare(images, arguments.seconds, folder),
            }
        for contest in arguments.only.split(","):
            found: dict[str, list[Figures]] = {who: [] for who in contests[contest]}
            for _ in range(arguments.rounds):
                for who, measure in contests[contest].items():
                    found[who].append(measure())
            print(table(found), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
