"""Sweeps: one core against two, a second sweep against the first, many short recordings, killed workers, Ray.

usage: python benchmarks/sweep.py parts [--parts 10] [--strides 2,3]  # the bundled recording, by graphs/cloud.yaml
       python benchmarks/sweep.py many [--recordings 1000]       # of 2 s each, by light operators
       python benchmarks/sweep.py many --recordings 60 --ray     # the same by a Ray cluster of this machine, too
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from threading import Event, Thread
from typing import Any

import psutil
import pyarrow.parquet as parquet

from dataflow.recording import Recording, RecordingWriter
from dataflow.sweep.table import TIMES

REPOSITORY = Path(__file__).resolve().parent.parent
DATAFLOW = (sys.executable, "-m", "dataflow.cli.start")
LIGHT = """
graph: light
namespace: robot1
operators:
  robot:
    use: operators.simulator:SimulatedRobot
    params:
      world: office
      duration: {duration}s
      first_stamp: 1700000000000000000
      color_camera: {{rate: 0}}
      depth_camera: {{rate: 0}}
      lidar: {{rate: 0}}
      inertial: {{rate: 50}}
      wheels: {{rate: 20}}
      truth: {{poses: 20, boxes: false, masks: false, relations: 0, activities: 0}}
  wheels:
    use: operators.odometry:WheelOdometry
    inputs: {{wheels: robot/wheel_ticks}}
    params: {{track: 0.4}}
  score:
    use: operators.evaluation:TrajectoryMetrics
    inputs: {{estimate: wheels/odometry, ground_truth: robot/true_base}}
record: {{exclude: [wheels/odometry, wheels/status]}}
"""
LASTS = 2
"""Seconds of each of many recordings."""
HUNDRED = 100
"""Recordings in a folder; with those of the first, workers are killed, and Ray is tried."""
KILL_EVERY = 8
"""Results between two kills: a run that is killed a second time is left to the next sweep."""
LOOK_EVERY = 0.5


def call(*words: object) -> str:
    """Runs a command; returns what it printed. Raises `CalledProcessError`."""
    command = [*DATAFLOW, *map(str, words)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY).stdout


def apart(pieces: Path, runs: Path) -> None:
    """Moves parts into a folder each, or they would be one recording."""
    for piece in sorted(pieces.glob("*.mcap")):
        (runs / piece.stem).mkdir(parents=True)
        piece.rename(runs / piece.stem / "run.mcap")


def cut(long: Path, runs: Path, number: int) -> None:
    """Writes recordings of `LASTS` seconds each: what the sensors of a long one gave then, and all that is static."""
    with Recording(long) as opened:
        first = min(info.first for info in opened.streams.values() if info.first is not None and not info.static)
        static = [m for m in opened.messages() if opened.streams[m.stream].static]
        for part in range(number):
            begin = first + part * LASTS * 10**9
            folder = runs / f"{part // HUNDRED:02}" / f"{part:04}"
            folder.mkdir(parents=True)
            with RecordingWriter(folder / "run.mcap", metadata={}, namespace="robot1") as written:
                for name, info in opened.streams.items():
                    assert info.message_type is not None
                    extra = {key: info.metadata[key] for key in ("operator", "port")}
                    written.add_stream(name, info.message_type, static=info.static, extra=extra)
                moving = [name for name, info in opened.streams.items() if not info.static]
                for m in (*static, *opened.messages(moving, begin, begin + LASTS * 10**9 - 1)):
                    written.write(m.stream, m.message, seq=m.seq)


class Swept:
    """A sweep as it goes: its time, its results, the memory of it and of its workers, and who kills them meanwhile."""

    def __init__(self, graph: object, runs: Path, out: Path, *words: object, killing: int = 0) -> None:
        self.out = out
        self.memory: list[tuple[float, float]] = []  # MB: of the command, of the largest of its workers
        self.killed = 0
        self._killing, self._chance, self._over = killing, random.Random(0), Event()
        line = ("sweep", graph, "--recordings", runs, "--out", out, *words, "--json", "--quiet")
        before, begun = os.times(), time.monotonic()
        process = subprocess.Popen([*DATAFLOW, *map(str, line)], stdout=subprocess.PIPE, text=True, cwd=REPOSITORY)
        watch = Thread(target=self._watch, args=(psutil.Process(process.pid),))
        watch.start()
        printed = process.communicate()[0]
        self.took = time.monotonic() - begun
        self._over.set()
        watch.join()
        after = os.times()
        self.cpu = sum(after[2:4]) - sum(before[2:4])
        self.told: dict[str, Any] = json.loads(printed)

    def _watch(self, command: psutil.Process) -> None:
        while not self._over.wait(LOOK_EVERY):
            try:
                workers = command.children()
                runs = [run for worker in workers for run in worker.children()]
                sizes = [worker.memory_info().rss for worker in workers]
                done = len(list((self.out / "results").glob("*.json")))
                if self.killed < self._killing and runs and done >= KILL_EVERY * (self.killed + 1):
                    self._chance.choice([self._chance.choice(runs), self._chance.choice(workers)]).kill()
                    self.killed += 1
                if runs:
                    self.memory.append((command.memory_info().rss / 1e6, max(sizes) / 1e6))
            except psutil.Error:  # it has ended since
                continue

    @property
    def row(self) -> str:
        """The row of a table: runs, seconds, CPU seconds a run."""
        ran = self.told["ran"]
        return f"{ran} | {self.took:.1f} | " + (f"{self.cpu / ran:.2f} |" if ran else "– |")

    def rows(self, below: str = "") -> list[dict[str, Any]]:
        """The table's rows of the recordings in a folder, without the columns of times."""
        found = parquet.read_table(self.out / "sweep.parquet").to_pylist()
        kept = [{name: value for name, value in row.items() if name not in TIMES} for row in found]
        return [row | {"recording": n[len(below) :]} for row in kept if (n := row["recording"]).startswith(below)]


def parts(number: int, folder: Path, strides: str) -> None:
    """One core, two cores, and two cores again."""
    runs, pieces = folder / "runs", folder / "pieces"
    call("split", "recordings/demo.mcap", "--every", f"{21 / number}s", "--out", pieces)
    apart(pieces, runs)
    print("| sweep | runs | s | CPU s a run |\n| --- | ---: | ---: | ---: |")
    swept = {}
    for name, jobs, out in (("one core", 1, "one"), ("two cores", 2, "two"), ("two cores, again", 2, "two")):
        swept[name] = Swept("graphs/cloud.yaml", runs, folder / out, "--jobs", jobs, "--set", f"cloud.stride={strides}")
        print(f"| {name} | {swept[name].row}")
    one, two, again = (each.took for each in swept.values())
    print(f"\ntwo cores are {one / two:.2f} times as quick as one")
    print(f"a second sweep takes {again / two:.1%} of the first")


def many(number: int, folder: Path, *, ray: bool) -> None:
    """Many short recordings: memory, a second sweep, killed workers; the same table by Ray."""
    graph, runs = folder / "light.yaml", folder / "runs"
    graph.write_text(LIGHT.format(duration=number * LASTS))
    call("run", graph, "--record", folder / "long.mcap", "--quiet", "--one-process")
    cut(folder / "long.mcap", runs, number)
    print("| sweep | runs | s | CPU s a run |\n| --- | ---: | ---: | ---: |")
    first = Swept(graph, runs, folder / "first", "--jobs", 2)
    print(f"| first | {first.row}")
    again = Swept(graph, runs, folder / "first", "--jobs", 2)
    print(f"| again | {again.row}")
    few, same = runs / "00", first.rows("00/")
    killing = Swept(graph, few, folder / "killed", "--jobs", 2, killing=10)
    print(f"| with {killing.killed} killed | {killing.row}")
    print(f"\na second sweep takes {again.took / first.took:.1%} of the first")
    quarter = len(first.memory) // 4
    for name, sizes in zip(("command", "worker"), zip(*first.memory, strict=True), strict=True):
        early, late = max(sizes[quarter : 2 * quarter]), max(sizes[-quarter:])
        print(f"MB of the {name}: {early:.0f} in the second quarter, {late:.0f} in the last")
    print(f"outcomes with {killing.killed} killed: {killing.told['settings'][0]['outcomes']}")
    print(f"its table is the same: {killing.rows() == same}")
    if ray:
        cluster = Swept(graph, few, folder / "ray", "--ray", "local", "--jobs", 2)
        print(f"Ray: {cluster.row}\nits table is the same: {cluster.rows() == same}")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("which", choices=("parts", "many"))
    options.add_argument("--parts", type=int, default=10)
    options.add_argument("--strides", default="2", help="values of cloud.stride for `parts`, such as 2,3")
    options.add_argument("--recordings", type=int, default=1000)
    options.add_argument("--ray", action="store_true")
    chosen = options.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    with tempfile.TemporaryDirectory() as folder:
        if chosen.which == "parts":
            parts(chosen.parts, Path(folder), chosen.strides)
        else:
            many(chosen.recordings, Path(folder), ray=chosen.ray)


if __name__ == "__main__":
    main()
