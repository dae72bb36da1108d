"""Does every operator repeat? Graphs run many times, in several processes; one digest means yes.

    python benchmarks/repeated_graphs.py [GRAPH ...] [--runs 20] [--seconds 3] [--set GRAPH.NAME=VALUE ...]

A digest is over all messages of an operator's streams, or over its figures where it has none. Four processes share the
runs of a graph. Graphs that need data or a network are named with `--set`. Several runs of some graphs each may
share a --json file, of which `--table FILE` prints the whole.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import xxhash

import dataflow
from dataflow.firing.threads import environment
from dataflow.graph import load_graph

REPOSITORY = Path(__file__).resolve().parent.parent
PROCESSES = 4
GRAPHS = (
    "cloud", "dead_reckoning", "depth", "fusion", "landmarks", "localize", "mapping", "mono", "movers", "orientation",
    "perception", "places", "preprocessing", "redundant", "registration", "simulated_lidar", "simulated_stereo", "slam",
    "slam_lidar", "synthetic_rgbd",
)  # fmt: skip

Row = dict[str, Any]


def digests(graph: str, settings: list[str]) -> dict[str, Row]:
    """Runs a graph here; returns the class, the number of messages or figures and the digest of every operator."""
    os.chdir(REPOSITORY)
    given = dict(one.split("=", 1) for one in settings)
    ran, found = dataflow.run(f"graphs/{graph}.yaml", settings=given), {}
    for name, node in load_graph(f"graphs/{graph}.yaml", settings=settings).nodes.items():
        streams = sorted(set(node.outputs.values()) & set(ran.report.streams))
        figures: dict[str, Any] = dict(ran.report.summaries.get(name) or {})
        told = {stream: list(ran.report.streams[stream]) for stream in streams} or figures
        count = sum(ran.report.streams[stream][0] for stream in streams) if streams else len(figures)
        digest = xxhash.xxh3_128_hexdigest(json.dumps(told, sort_keys=True).encode())
        found[name] = {"operator": node.use.partition(":")[2], "messages": count, "digest": digest}
    return found


def repeated(graph: str, settings: list[str], runs: int) -> list[Row]:
    """Returns a row for each operator of a graph."""
    seen: dict[str, list[Row]] = defaultdict(list)
    for k in range(PROCESSES):
        share = len(range(k, runs, PROCESSES))
        command = [sys.executable, __file__, graph, "--one", str(share), "--set", *(f"{graph}.{s}" for s in settings)]
        done = subprocess.run(command, env=environment(1), capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{graph}: exit code {done.returncode}: {done.stderr.strip()[-300:]}")
        for run in json.loads(done.stdout):
            for name, row in run.items():
                seen[name].append(row)
    return [
        {"operator": every[0]["operator"], "graph": graph, "name": name, "messages": every[0]["messages"],
         "runs": len(every), "digests": len({row["digest"] for row in every}), "first": every[0]["digest"]}
        for name, every in seen.items()
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
    return sorted({row["operator"] for row in rows if row["digests"] > 1})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graphs", nargs="*", default=list(GRAPHS), help="names of graphs/NAME.yaml")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=3.0, help="`duration` of graphs that have it")
    parser.add_argument("--set", nargs="*", default=[], metavar="GRAPH.NAME=VALUE")
    parser.add_argument("--json", type=Path, help="file to which all rows are added")
    parser.add_argument("--table", type=Path, help="prints the table of such a file, and runs nothing")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.table:
        table(json.loads(arguments.table.read_text()))
        return
    rows = []
    for name in arguments.graphs:
        settings = [one.partition(".")[2] for one in arguments.set if one.startswith(f"{name}.")]
        if arguments.one:
            print(json.dumps([digests(name, settings) for _ in range(arguments.one)]))
            return
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
