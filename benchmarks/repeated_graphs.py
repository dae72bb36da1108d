"""Does every operator repeat? Graphs run many times, each time in processes of their own; one digest means yes.

    python benchmarks/repeated_graphs.py [GRAPH ...] [--runs 20] [--seconds 3] [--set GRAPH.NAME=VALUE ...]

A digest is over all messages of an operator's streams, or over its figures where it has none. Graphs that need data or
a network of yours are named with `--set`. Several runs of some graphs each may share a --json file, of which
`--table FILE` prints the whole.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import xxhash

from dataflow.api.graphs import resolved
from dataflow.recording import Recording

REPOSITORY = Path(__file__).resolve().parent.parent
GRAPHS = (
    "cloud", "dead_reckoning", "depth", "fusion", "landmarks", "localize", "mapping", "mono", "movers", "orientation",
    "perception", "places", "preprocessing", "redundant", "registration", "simulated_lidar", "simulated_stereo", "slam",
    "slam_lidar", "synthetic_rgbd",
)  # fmt: skip


def whole(folder: Path) -> Path:
    """Returns a copy of the graphs that records every stream."""
    copy = folder / "graphs"
    shutil.copytree(REPOSITORY / "graphs", copy)
    for file in copy.rglob("*.yaml"):
        text = file.read_text(encoding="utf-8")
        file.write_text(re.sub("^record:.*\n", "", text, flags=re.MULTILINE), encoding="utf-8")
    return copy


def digests(graph: Path, settings: list[str], folder: Path) -> dict[str, tuple[str, int, str]]:
    """Runs a graph; returns the class, the number of messages or figures and the digest of every operator."""
    file, words = folder / "run.mcap", [word for one in settings for word in ("--set", one)]
    command = [sys.executable, "-m", "dataflow.cli.main", "run", str(graph), "--record", str(file), "--overwrite"]
    done = subprocess.run([*command, "--json", "--quiet", *words], cwd=REPOSITORY, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{graph.stem}: exit code {done.returncode}: {done.stderr.strip()[-300:]}")
    summaries: dict[str, Any] = json.loads(done.stdout)["summaries"]
    found = {}
    with Recording(file) as recording:
        for name, node in resolved(graph, dict(one.split("=", 1) for one in settings)).nodes.items():
            streams = sorted(set(node.outputs.values()) & set(recording.streams))
            figures: dict[str, Any] = summaries.get(name) or {}
            told = recording.digests(streams) if streams else figures
            count = sum(recording.streams[stream].count for stream in streams) if streams else len(figures)
            digest = xxhash.xxh3_128_hexdigest(json.dumps(dict(told), sort_keys=True).encode())
            found[name] = node.use.partition(":")[2], count, digest
    return found


def repeated(graph: str, settings: list[str], runs: int) -> list[dict[str, Any]]:
    """Returns a row for each operator of a graph."""
    seen: dict[str, list[tuple[str, int, str]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        copy = whole(Path(folder)) / f"{graph}.yaml"
        for _ in range(runs):
            for name, one in digests(copy, settings, Path(folder)).items():
                seen[name].append(one)
    return [
        {"operator": every[0][0], "graph": graph, "name": name, "messages": every[0][1], "runs": len(every),
         "digests": len({digest for _, _, digest in every}), "first": every[0][2]}
        for name, every in seen.items()
    ]  # fmt: skip


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Prints what was found of each operator, over all graphs; returns those that differ."""
    by_operator: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        if row["messages"]:
            by_operator[row["operator"]].append(row)
    print("| operator | graphs | messages or figures | runs | digests |\n| --- | --- | ---: | ---: | ---: |")
    for operator, found in sorted(by_operator.items()):
        graphs = ", ".join(dict.fromkeys(row["graph"] for row in found))
        most, runs = max(row["digests"] for row in found), min(row["runs"] for row in found)
        print(f"| {operator} | {graphs} | {sum(row['messages'] for row in found)} | {runs} | {most} |")
    return sorted({row["operator"] for row in rows if row["digests"] > 1})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graphs", nargs="*", default=list(GRAPHS), help="names of graphs/NAME.yaml")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=3.0, help="`duration` of graphs that have it")
    parser.add_argument("--set", nargs="*", default=[], metavar="GRAPH.NAME=VALUE")
    parser.add_argument("--json", type=Path, help="file to which all rows are added")
    parser.add_argument("--table", type=Path, help="prints the table of such a file, and runs nothing")
    arguments = parser.parse_args()
    if arguments.table:
        table(json.loads(arguments.table.read_text()))
        return
    rows = []
    for name in arguments.graphs:
        settings = [one.partition(".")[2] for one in arguments.set if one.startswith(f"{name}.")]
        if "duration:" in (REPOSITORY / "graphs" / f"{name}.yaml").read_text(encoding="utf-8"):
            settings.append(f"duration={round(1e3 * arguments.seconds)}ms")
        rows += repeated(name, settings, arguments.runs)
        print(f"{name}: {max(row['digests'] for row in rows if row['graph'] == name)}", file=sys.stderr, flush=True)
        if arguments.json:
            known = json.loads(arguments.json.read_text()) if arguments.json.is_file() else []
            arguments.json.write_text(json.dumps([*known, *(r for r in rows if r["graph"] == name)], indent=1) + "\n")
    differing = table(rows)
    if differing:
        sys.exit(f"not repeatable: {', '.join(differing)}")


if __name__ == "__main__":
    main()
