"""How long does the debugger take to a call, back among the last 256, and to make one again?

python benchmarks/debugging.py RECORDING [OPERATOR...]

Prints seconds of CPU time by operator: opening; the largest of jumps by a new debugger to calls at a quarter, half and
95 % of the recording; the largest of jumps back among the last 256 calls; a call made again and compared, source files
looked at for edits; and `until` to the end, against what verification takes for the same calls.
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

PLACES = (0.25, 0.5, 0.95)
BACK = 256
JUMPS = 10


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


def row(recording: Recording, graph: Graph, name: str) -> str:
    """The figures of one operator."""
    cold = []
    for place in PLACES:
        debugger = Debugger(recording, name, graph)
        number = round(place * (len(debugger.calls) - 1))
        cold.append(cpu(lambda: debugger.goto(number)))  # noqa: B023 - called at once
        debugger.close()
    opening = cpu(lambda: Debugger(recording, name, graph))
    debugger = Debugger(recording, name, graph)
    through = cpu(lambda: debugger.until(lambda fired: False))
    last = len(debugger.calls) - 1
    debugger.goto(last)
    numbers = random.Random(1).choices(range(max(0, last - BACK), last), k=JUMPS)
    back = max(cpu(lambda: debugger.goto(number)) for number in numbers)  # noqa: B023 - called at once
    debugger.reload()
    again = cpu(lambda: (debugger.reload(), debugger.again()))
    debugger.close()
    repeated = cpu(lambda: verified(recording, graph, name))
    kind = "none" if graph.nodes[name].operator.stateless else "state"
    times = f"{opening:.2f} | {max(cold):.2f} | {back:.2f} | {again:.2f} | {through:.1f} | {repeated:.1f}"
    return f"| {name} | {kind} | {last + 1} | {times} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("operators", nargs="*", help="all that can be gone to, if none")
    options = parser.parse_args()
    print("| operator | state | calls | opening, s | cold jump, s | back, s | again, s | until, s | verify, s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with Recording(options.recording) as recording:
        graph, _ = graph_that_is_here(recording)
        there = [node.name for node in graph.nodes.values() if node.taken and not node.external]
        for name in options.operators or there:
            print(row(recording, graph, name), flush=True)


if __name__ == "__main__":
    main()
