"""How long is an operator away while it is reloaded, and does the run verify identical? Prints a table.

python benchmarks/reload.py [--times 10]

A synthetic camera at 30 Hz runs live into the shipped visual odometry (a state) and the shipped detector (a network),
each behind a class of this script's making whose code is changed and reloaded again and again. The gap is the time from
the end of the last call of the old code to the beginning of the first of the new one, by the firing records: the wait
for the next image is part of it. Exit code 1 where a gap is longer than 1 s or the run does not verify identical.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from dataflow.execution.live import LiveRunner
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import recorded_firings
from dataflow.sync import Entry

GRAPH = """\
graph: reload_benchmark
operators:
  camera: {use: "operators.sources:SyntheticRgbd", params: {frames: 100000, rate: 30}}
  odometry:
    use: reloaded_by_benchmark:Odometry
    inputs: {image: camera/image, depth: camera/depth, image_info: camera/image_info, depth_info: camera/depth_info,
      extrinsics: camera/extrinsics}
  detector: {use: "reloaded_by_benchmark:Detector", inputs: {image: camera/image}, params: {model: MODEL}}
"""
CODE = """\
from operators.detection import OnnxDetector
from operators.odometry import VisualOdometry

VERSION = {version}


class Odometry(VisualOdometry):
    pass


class Detector(OnnxDetector):
    pass
"""


def main() -> int:
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--times", type=int, default=10, help="reloads of each operator")
    times = arguments.parse_args().times
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["XDG_DATA_HOME"] = name  # for what reloads store
        network = Path(__file__).resolve().parents[1] / "operators" / "weights" / "detector.onnx"
        (folder / "graph.yaml").write_text(GRAPH.replace("MODEL", str(network)))
        _write(folder, 0)
        run = _start(folder, ["run", "graph.yaml", "--live", "--quiet", "--record", "run.mcap"])
        for version in range(1, times + 1):
            time.sleep(1)
            _write(folder, version)
            for operator in ("odometry", "detector"):
                if _start(folder, ["reload", operator, "--graph", "reload_benchmark", "--wait", "60"]).wait(90):
                    run.kill()
                    raise SystemExit(f"{operator} was not reloaded")
        time.sleep(1)
        run.send_signal(signal.SIGINT)
        run.wait(90)
        identical = _start(folder, ["verify", "run.mcap"]).wait(600) == 0
        longest, computed = 0.0, _computed(folder)
        print("| operator | reloads | gap, median | longest | CPU time |\n| --- | ---: | ---: | ---: | ---: |")
        for operator in ("odometry", "detector"):
            gaps = _gaps(folder / "run.mcap", operator)
            longest = max(longest, *gaps)
            figures = (statistics.median(gaps), max(gaps), computed[operator])
            print(f"| {operator} | {len(gaps)} | " + " | ".join(f"{figure:.3f} s" for figure in figures) + " |")
        print(f"\nThe run verifies {'identical' if identical else 'NOT identical'}.")
    return int(longest > 1 or not identical)


class _Nowhere:
    """An emitter whose messages reach nobody."""

    def message(self, stream: str, entry: Entry) -> None: ...

    def frontier(self, stream: str, frontier: int) -> None: ...

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None: ...

    def record(self, record: FiringRecord) -> None: ...


def _computed(folder: Path) -> dict[str, float]:
    """CPU seconds of a reload by operator, in this process: the median of three."""
    sys.path.insert(0, str(folder))
    graph, found = load_graph(folder / "graph.yaml", live=True), {}
    for name in ("odometry", "detector"):
        runner = LiveRunner(graph.nodes[name], _Nowhere(), static=graph.static)
        runner.setup()
        spent = []
        for version in range(-3, 0):
            _write(folder, version)
            began = time.process_time()
            runner.reload()
            spent.append(time.process_time() - began)
        found[name] = statistics.median(spent)
    return found


def _write(folder: Path, version: int) -> None:
    (folder / "reloaded_by_benchmark.py").write_text(CODE.format(version=version))


def _start(folder: Path, words: Sequence[str]) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.Popen([sys.executable, "-m", "dataflow.cli.main", *words], cwd=folder, env=environment)


def _gaps(recording: Path, operator: str) -> list[float]:
    """Seconds between the last call of each incarnation and the first of the next."""
    gaps, last = [], None
    with Recording(recording) as opened:
        for record in recorded_firings(opened, operator):
            if record.kind in CALLS:
                if last is not None and record.incarnation > last.incarnation:
                    gaps.append((record.wall_start - last.wall_start - last.duration) * 1e-9)
                last = record
    return gaps


if __name__ == "__main__":
    raise SystemExit(main())
