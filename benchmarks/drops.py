"""Does `dataflow drops` name the losses that cost a figure, among many that did not? Prints a table.

python benchmarks/drops.py [--seeds 0:20] [--demo recordings/demo.mcap]

Live runs of 8 s on a clock turned by hand (`tests/support/held_runs.py`) lose about a hundred messages: operators stand
still, messages come late. One loss is injected that costs the estimate 10 m or 20 m. `--demo`: then the odometry branch
of the bundled recording, with 400 drops. Times are by the clock; *re-runs* is the search's by that of one re-run alone,
both with reading the recording and making the operators (medians of 5; one for `--demo`). Exit code 1 where an injected
loss is not named.
"""

from __future__ import annotations

import argparse
import gc
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY / "tests" / "support"))

import held_runs  # noqa: E402

from dataflow.drops.search import Cost, Drops  # noqa: E402
from dataflow.graph import load_text  # noqa: E402
from dataflow.recording import Recording  # noqa: E402

STEPS = 400
ODOMETRY = """
graph: branch
namespace: robot1
operators:
  robot:
    use: operators.simulator:SimulatedRobot
    params:
      world: office
      color_camera: {rate: 10, width: 320, height: 240, output: jpeg}
      depth_camera: {rate: 10, output: png}
      truth: {poses: 10}
  color: {use: 'operators.codec:ImageDecoder', inputs: {compressed: robot/image_jpeg}, live: {queue: newest, size: 1}}
  depth: {use: 'operators.codec:DepthDecoder', inputs: {compressed: robot/depth_png}, live: {queue: newest, size: 1}}
  odometry:
    use: operators.odometry:VisualOdometry
    inputs:
      image: color/image
      depth: depth/depth
      image_info: robot/image_info
      depth_info: robot/depth_info
      extrinsics: robot/extrinsics
    live: {queue: newest, size: 1, wait: 50ms}
  trajectory_score:
    use: operators.evaluation:TrajectoryMetrics
    inputs: {estimate: odometry/odometry, ground_truth: robot/ground_truth}
    live: {queue: block, wait: 200ms}
"""


def faults(seed: int) -> tuple[held_runs.Faults, int, str]:
    """About a hundred losses that cost little, and one that costs much: its stamp (ns) and its input."""
    draw = random.Random(seed)
    large = draw.randrange(STEPS // 100) * 100 + 50
    still, late, k = [], {}, 5
    while k < STEPS - 20:
        length = draw.randrange(8, 16)
        if not any(k <= each <= k + length + 8 for each in range(50, STEPS, 100)):
            still.append((draw.choice(["odometry", "smooth"]), k, k + length))
        k += length + draw.randrange(9, 20)
    dropped = draw.random() < 0.5
    if dropped:
        still.append(("odometry", large - 2, large + 8))
    else:
        late["turn", large // 2] = 60
    turns = [
        t
        for t in range(STEPS // 2)
        if t % 25 not in (0, 13) and not any(abs(2 * t - s) < 8 for s in range(50, STEPS, 100))
    ]
    late |= {("turn", t): 60 for t in draw.sample(turns, 15)}
    return held_runs.Faults(late, still), held_runs.STAMP + large * 20 * held_runs.MS, "step" if dropped else "turn"


def searched(path: Path, worse: str, budget: float, times: int) -> tuple[Cost, float, float]:
    """Looks for losses; returns them, the seconds that it takes, and those of one re-run: medians of some `times`."""
    whole, alone = [], []
    for _ in range(times):
        gc.collect()  # of what was before
        began = time.perf_counter()
        with Recording(path) as recording:
            Drops(recording, worse).figures_without(())
        alone.append(time.perf_counter() - began)
        gc.collect()
        began = time.perf_counter()
        with Recording(path) as recording:
            cost = Drops(recording, worse, budget=budget).find()
        whole.append(time.perf_counter() - began)
    return cost, statistics.median(whole), statistics.median(alone)


def made(seeds: range) -> int:
    print("| seed | losses | injected | named | replays | seconds | one re-run, s | re-runs |")
    print("| ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: |")
    right, most = 0, 0.0
    for seed in seeds:
        given, stamp, name = faults(seed)
        with tempfile.TemporaryDirectory() as folder:
            path = held_runs.recorded(held_runs.graph(STEPS), given, Path(folder) / "run.mcap")
            cost, took, once = searched(path, "end_error_m > 5", 600.0, 5)
        right += (stamp, name) in {(loss.stamp, loss.input) for loss in cost.named}
        most = max(most, took / once)
        numbers = f"{len(cost.named)} | {cost.replays} | {took:.2f} | {once:.3f} | {took / once:.1f}"
        print(
            f"| {seed} | {cost.losses} | {name} at {(stamp - held_runs.STAMP) * 1e-9:.1f} s | {numbers} |", flush=True
        )
    print(f"\n{right} of {len(seeds)} injected losses are named; at most the time of {most:.1f} re-runs")
    return int(right < len(seeds))


def branch(path: Path, budget: float) -> tuple[Cost, float, float]:
    """Has the odometry branch of a recording lose 400 messages, and looks for those that cost its error."""
    draw = random.Random(0)
    late = {("depth_png", k): 400 for k in draw.sample(range(20, 200), 20)}
    still = [
        (name, k, k + 22) for name in ("color", "depth", "odometry") for k in range(60, 1000, 31) if draw.random() < 0.9
    ]
    still.append(("odometry", 400, 700))
    graph = load_text(ODOMETRY)
    with tempfile.TemporaryDirectory() as folder:
        with Recording(path) as played:
            made = held_runs.recorded(graph, held_runs.Faults(late, still), Path(folder) / "run.mcap", played)
        return searched(made, "ate_rmse_m > 0.015", budget, 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:20", help="FIRST:END")
    parser.add_argument("--demo", type=Path, help="recordings/demo.mcap")
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for that")
    given = parser.parse_args()
    first, end = map(int, given.seeds.split(":"))
    wrong = made(range(first, end))
    if given.demo is not None:
        cost, took, once = branch(given.demo, given.budget)
        print(
            f"\n{len(cost.named)} of {cost.losses} losses named, {cost.replays} replays, {cost.calls:,} calls made, ",
            end="",
        )
        figures = [dict(found) for found in (cost.figures, cost.undone, cost.best)]
        print("{:.1f} s, one re-run {:.1f} s; {}, without these {}, without any {}".format(took, once, *figures))
    return wrong


if __name__ == "__main__":
    raise SystemExit(main())
