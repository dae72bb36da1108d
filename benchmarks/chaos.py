"""Live runs under fault plans with different seeds, each verified in another placement than it ran in.

usage: python benchmarks/chaos.py [--runs 50] [--first 1] [--duration 10s]

Every run: graphs/chaos/robot.yaml live with cameras at 20 Hz, in one process or a process each by turns, with the
faults of benchmarks/chaos_plan.yaml, another seed each. In one process operators fail instead of being killed: that
would kill the simulator too, which takes seconds to build its world again. Then `verify` of its recording, in several
worker processes where it ran in one, and in one where it ran in several.

Drops are those in the firing records; `limit` is the speed that the slowest operator's (in one process: all operators')
own work allows. Prints a row per run and a summary; exit code 1 unless all are identical.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from ruamel.yaml import YAML

from dataflow.chaos.plan import plan_of
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.run import run
from dataflow.verification.verify import verify

ROOT = Path(__file__).resolve().parent.parent
GRAPH, PLAN = ROOT / "graphs" / "chaos" / "robot.yaml", ROOT / "benchmarks" / "chaos_plan.yaml"
SETTINGS = (
    "robot.color_camera={rate: 20, width: 160, height: 120, output: jpeg}",
    "robot.depth_camera={rate: 20, output: png}",
)
COLUMNS = "seed  placement  faults  restarts  drops  timeouts  messages  verdict      x real time  limit"


def one(seed: int, placement: str, duration: str, folder: Path) -> tuple[bool, int, int, int]:
    """Runs and verifies; prints the row. Returns whether it is identical, drops, timeouts and restarts."""
    graph = load_graph(GRAPH, settings=[f"duration={duration}", *SETTINGS], live=True)
    path = folder / f"{seed}.mcap"
    content = YAML(typ="safe").load(PLAN.read_text())
    if placement == "one_process":
        content["faults"] = [{**f, "kind": "raise"} if f["kind"] == "kill" else f for f in content["faults"]]
    faults = plan_of(content, graph, seed=seed)
    report = run(graph, live=True, placement=placement, record=path, overwrite=True, faults=faults)
    together = placement == "one_process"
    verified = verify(path, jobs=None if together else 1)
    with Recording(path) as recording:
        drops = sum(len(r.drops) for name in graph.nodes for r in recorded_firings(recording, name))
    path.unlink()
    timeouts = sum(n for found in report.waits.values() for _, what, n in found if what == "timeout")
    planned = sum(note.startswith("planned fault") for note in report.notes)
    restarts = sum(report.restarts.values())
    work = [c.cpu_ns * 1e-9 for name, c in verified.work.items()]
    slowest = max(work) if together else sum(work)
    factor, limit = verified.span / verified.wall, verified.span / slowest
    verdict = "identical" if verified.identical else "DIFFERENT"
    print(
        f"{seed:4}  {placement:9}  {planned:6}  {restarts:8}  {drops:5}  {timeouts:8}  {verified.messages:8}  "
        f"{verdict:11}  {factor:11.2f}  {limit:5.2f}",
        flush=True,
    )
    if not verified.identical:
        for v in verified.operators:
            print(f"      {v.operator}: {v.verdict} {v.verified}/{v.firings} {v.missing} {v.first}", flush=True)
    return verified.identical, drops, timeouts, restarts


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50, help="how many seeds")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--duration", default="10s", help="event time of a run")
    arguments = parser.parse_args()
    started = time.monotonic()
    print(COLUMNS)
    with tempfile.TemporaryDirectory() as folder:
        results = [
            one(seed, "one_process" if seed % 2 else "process_each", arguments.duration, Path(folder))
            for seed in range(arguments.first, arguments.first + arguments.runs)
        ]
    identical = sum(same for same, *_ in results)
    drops, timeouts, restarts = (sum(column) for column in list(zip(*results, strict=True))[1:])
    print(
        f"\n{identical} of {len(results)} identical; {drops:,} drops, {timeouts:,} timeouts, {restarts:,} restarts; "
        f"{time.monotonic() - started:.0f} s"
    )
    return 0 if identical == len(results) else 1


if __name__ == "__main__":
    sys.exit(main())
