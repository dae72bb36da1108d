"""Does every operator repeat? Graphs run many times, in several processes; one digest means yes.

    python benchmarks/repeated_graphs.py [GRAPH ...] [--runs 20] [--set GRAPH.NAME=VALUE ...]
    python benchmarks/repeated_graphs.py --data DATA

A digest is over all messages of an operator's streams, or over its figures where it has none. Four processes share the
runs. A simulated drive is recorded once and replayed, but for two graphs whose sources run as often. With `--data`,
the folder that graphs/stereo.yaml and its like take, those graphs run too. Graphs named alone may need `--set`. What
no graph of graphs/ runs alone has weights, a video, a bag or a small graph made by repeated_made.py.
Several runs of some graphs each may share a --json file, of which `--table FILE` prints the whole.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xxhash
from repeated_made import MADE, maps, perceived

import dataflow
from dataflow.execution.threads import environment
from dataflow.graph import load_graph
from dataflow.operator import Operator, Source

REPOSITORY = Path(__file__).resolve().parent.parent
PROCESSES = 4
WITHIN = 7200  # seconds that one of them may take
GRAPHS: dict[str, tuple[str, ...]] = {  # with the settings that make them short, and yet have every operator speak
    "cloud": ("duration=600ms",),
    "dead_reckoning": ("duration=2s",),
    "depth": ("duration=600ms",),
    "fusion": ("duration=1500ms",),
    "landmarks": ("duration=3s",),
    "localize": ("duration=2s",),
    "mapping": ("duration=800ms",),
    "mono": ("duration=1500ms",),
    "movers": ("duration=700ms",),
    "orientation": ("duration=3s",),
    "perception": ("duration=1500ms",),
    "places": ("duration=2s",),
    "preprocessing": ("duration=800ms",),
    "redundant": ("duration=1200ms",),
    "registration": ("duration=2s",),
    "simulated_lidar": ("duration=1s",),
    "simulated_robot": ("duration=800ms",),
    "simulated_stereo": ("duration=1s",),
    "slam": ("duration=1500ms",),
    "slam_lidar": ("duration=2s",),
    "synthetic_rgbd": ("frames=15",),
}
SIMULATED = (
    "simulated_robot",
    "synthetic_rgbd",
)  # whose sources run as well; the others are recorded once, and replayed
WITH_DATA: dict[str, tuple[str, ...]] = {
    "landmarks_park": ("file={data}/landmark_slam/victoria_park.txt",),
    "lidar": ("path={data}/kitti_lidar_camera", "drive.stop=8"),
    "mono_depth": ("model={data}/models/tcmonodepth_small_192x320.onnx", "duration=1s"),
    "mono_folder": ("data={data}", "camera.stop=20"),
    "orientation_broad": ("file={data}/broad_imu/02_undisturbed_slow_rotation_B.hdf5", "trial.stop=6000"),
    "orientation_euroc": ("folder={data}/euroc_v1_01_imu",),
    "rgbd_perception": ("data={data}", "camera.stop=15"),
    "slam_folder": ("data={data}", "camera.stop=30"),
    "stereo": ("data={data}", "camera.stop=8"),
}

Row = dict[str, Any]


def digests(graph: str, settings: list[str], folder: Path) -> dict[str, Row]:
    """Runs a graph here, or replays through it what a folder has for it; returns the class, the number of messages or
    figures and the digest of every operator that ran."""
    os.chdir(REPOSITORY)
    recording, bag, own = (folder / f"{graph}.{kind}" for kind in ("mcap", "bag", "yaml"))
    file, given, found = (
        own if own.exists() else f"graphs/{graph}.yaml",
        dict(one.split("=", 1) for one in settings),
        {},
    )
    if graph == "handed":
        return perceived(recording)
    if bag.exists():
        ran = dataflow.replay(bag, graph=file, maps=maps())
    elif recording.exists():
        ran = dataflow.replay(recording, graph=file, settings=given)
    else:
        ran = dataflow.run(file, settings=given)
    for name, node in load_graph(file, settings=settings).nodes.items():
        if node.source and recording.exists():
            continue
        streams = sorted(set(node.outputs.values()) & set(ran.report.streams))
        figures: dict[str, Any] = dict(ran.report.summaries.get(name) or {})
        told = {stream: list(ran.report.streams[stream]) for stream in streams} or figures
        count = sum(ran.report.streams[stream][0] for stream in streams) if streams else len(figures)
        digest = xxhash.xxh3_128_hexdigest(json.dumps(told, sort_keys=True).encode())
        found[name] = {"operator": node.use.partition(":")[2], "messages": count, "digest": digest}
    return found


def repeated(graphs: Mapping[str, list[str]], runs: int, folder: Path) -> list[Row]:
    """Runs graphs with their settings; returns a row for each operator of each. Recordings lie in a folder."""
    for name, settings in graphs.items():
        if name in MADE:
            settings += MADE[name](folder)
        if name in GRAPHS and name not in SIMULATED:
            given = dict(one.split("=", 1) for one in settings)
            dataflow.run(f"graphs/{name}.yaml", settings=given, record=folder / f"{name}.mcap")
    words = [f"{name}.{setting}" for name, settings in graphs.items() for setting in settings]
    seen: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for k in range(min(PROCESSES, runs)):
        share = ["--one", str(len(range(k, runs, PROCESSES))), "--recordings", str(folder)]
        command = [sys.executable, __file__, *graphs, *share, "--set", *words]
        done = subprocess.run(command, env=environment(1), capture_output=True, text=True, check=False, timeout=WITHIN)
        if done.returncode:
            raise RuntimeError(f"{', '.join(graphs)}: exit code {done.returncode}: {done.stderr.strip()[-300:]}")
        for graph, run in json.loads(done.stdout):
            for name, row in run.items():
                seen[graph, name].append(row)
    return [
        {"operator": every[0]["operator"], "graph": graph, "name": name, "messages": every[0]["messages"],
         "runs": len(every), "digests": len({row["digest"] for row in every}), "first": every[0]["digest"]}
        for (graph, name), every in seen.items()
    ]  # fmt: skip


def table(rows: list[Row]) -> list[str]:
    """Prints what was found of each operator, over all graphs; returns those that differ."""
    by_operator: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        if row["messages"]:
            by_operator[row["operator"]].append(row)
    print("| operator | graphs | messages or figures | runs | digests |\n| --- | --- | ---: | ---: | ---: |")
    for operator, found in sorted(by_operator.items()):
        graphs = ", ".join(dict.fromkeys(row["graph"] for row in found))
        most, runs = max(row["digests"] for row in found), min(row["runs"] for row in found)
        print(f"| {operator} | {graphs} | {sum(row['messages'] for row in found)} | {runs} | {most} |")
    absent = sorted(set(operators()) - set(by_operator))
    print(f"\nIn no row: {', '.join(absent) or 'none'}.")
    return sorted({row["operator"] for row in rows if row["digests"] > 1})


def operators() -> list[str]:
    """Returns the classes of all operators and sources that come with the project."""
    names = []
    for folder in sorted((REPOSITORY / "operators").iterdir()):
        if (folder / "__init__.py").is_file():
            module = importlib.import_module(f"operators.{folder.name}")
            public = [getattr(module, name) for name in getattr(module, "__all__", ())]
            names += [c.__name__ for c in public if isinstance(c, type) and issubclass(c, Operator | Source)]
    return names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graphs", nargs="*", help="names of graphs/NAME.yaml; none means all")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--data", type=Path, help="folder of recorded data")
    parser.add_argument("--set", nargs="*", default=[], metavar="GRAPH.NAME=VALUE")
    parser.add_argument("--json", type=Path, help="file to which all rows are added")
    parser.add_argument("--table", type=Path, help="prints the table of such a file, and runs nothing")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--recordings", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.table:
        table(json.loads(arguments.table.read_text()))
        return

    def given(name: str) -> list[str]:
        return [one.partition(".")[2] for one in arguments.set if one.startswith(f"{name}.")]

    if arguments.one:
        each = [name for name in arguments.graphs for _ in range(arguments.one)]
        print(json.dumps([(name, digests(name, given(name), arguments.recordings)) for name in each]))
        return
    known = GRAPHS | dict.fromkeys(MADE, ())
    if arguments.data:
        folder = arguments.data.resolve()
        known |= {name: tuple(one.format(data=folder) for one in settings) for name, settings in WITH_DATA.items()}
    graphs = {name: [*known.get(name, ()), *given(name)] for name in arguments.graphs or known}
    os.chdir(REPOSITORY)
    with tempfile.TemporaryDirectory() as folder:
        rows = repeated(graphs, arguments.runs, Path(folder))
    if arguments.json:
        before = json.loads(arguments.json.read_text()) if arguments.json.is_file() else []
        arguments.json.write_text(json.dumps([*before, *rows], indent=1) + "\n")
    differing = table(rows)
    if differing:
        sys.exit(f"not repeatable: {', '.join(differing)}")


if __name__ == "__main__":
    main()
