"""How long does the debugger take to a call, back among the last 256, and to make one again?

python benchmarks/debugging.py RECORDING [OPERATOR...]

Prints seconds of CPU time by operator: opening; of jumps by a new debugger to calls drawn by chance, the 95th
percentile; of jumps back among the last 256 calls the same, and of the state there; a call made again and compared,
source files looked at for edits; and `until` to the end, against what verification takes for the same calls.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable
from pathlib import Path

from dataflow.debugging.debugger import Debugger
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.records.reading import FiringLog
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.reexecution.recorded_run import graph_that_is_here

COLD = 8
BACK = 256
JUMPS = 20


def cpu(act: Callable[[], object]) -> float:
    """Seconds of CPU time that something takes."""
    began = time.process_time()
    act()
    return time.process_time() - began


def verified(recording: Recording, graph: Graph, name: str) -> None:
    """Repeats all calls of an operator, as verification does."""
    feeding = plan_feeding(recording, graph, [name])
    work = Recomputation(recording, graph, feeding, FiringLog.read(recording), made=lambda stream, entry: None)
    work.run()


def p95(times: list[float]) -> float:
    """The time that 95 % of some do not exceed."""
    return sorted(times)[round(0.95 * (len(times) - 1))]


def row(recording: Recording, graph: Graph, name: str, jumps: int) -> str:
    """The figures of one operator."""
    opening = cpu(lambda: Debugger(recording, name, graph))
    debugger = Debugger(recording, name, graph)
    last = len(debugger.calls) - 1
    debugger.goto(0)  # loads modules and libraries
    cold = []
    for number in random.Random(1).choices(range(last + 1), k=jumps):
        fresh = Debugger(recording, name, graph)
        cold.append(cpu(lambda: fresh.goto(number)))  # noqa: B023 - called at once
        fresh.close()
    through = cpu(lambda: debugger.until(lambda fired: False))
    numbers = random.Random(1).choices(range(max(0, last - BACK + 1), last), k=JUMPS)
    back, states = [], []
    for number in numbers:
        back.append(cpu(lambda: debugger.goto(number)))  # noqa: B023 - called at once
        states.append(cpu(lambda: debugger.goto(number).packed()))  # noqa: B023 - called at once
    debugger.reload()
    again = cpu(lambda: (debugger.reload(), debugger.again()))
    debugger.close()
    repeated = cpu(lambda: verified(recording, graph, name))
    kind = "none" if graph.nodes[name].operator.stateless else "state"
    jumped = f"{p95(cold):.2f} | {p95(back):.3f} | {p95(states):.2f}"
    return f"| {name} | {kind} | {last + 1} | {opening:.2f} | {jumped} | {again:.2f} | {through:.1f} | {repeated:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("operators", nargs="*", help="all that can be gone to, if none")
    parser.add_argument("--jumps", type=int, default=COLD, help="cold ones of each operator")
    options = parser.parse_args()
    print("| operator | state | calls | opening | cold jump | back | its state | again | until | verify |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with Recording(options.recording) as recording:
        graph, _ = graph_that_is_here(recording)
        there = [node.name for node in graph.nodes.values() if node.taken and not node.external]
        for name in options.operators or there:
            print(row(recording, graph, name, options.jumps), flush=True)


if __name__ == "__main__":
    main()
