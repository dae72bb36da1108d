"""Firings per second in one process, and the CPU time of one as a graph grows.

    python benchmarks/firings.py
    python benchmarks/firings.py --against OTHER_TREE     # another checkout in turns with this one: ratios
    python benchmarks/firings.py --memory                 # 1,000,000 messages, a minute or more
    python benchmarks/firings.py --processes              # the chain with a process for each operator
    python benchmarks/firings.py --apart                  # the CPU time of a firing where each operator has a process

Chains (a source, relays, a sink) and fans (a source, sinks) of small messages run in one process as fast as they go,
each in a separate interpreter. Time is taken inside that process every 20 messages, without start-up; CPU time is
the whole process's. The figures are those of the tenth of the time that was least disturbed (`--json` has the means,
too): other work on the machine does not decide. With several rounds the table gives medians, and of ratios the smallest
and the largest beside them. The floor is the same chain as plain calls of Python functions: makes the array
and the message's dictionary, digests it, packs a record of 40 bytes; no checks, no order, no frontiers.

With `--apart`, each operator and the source has its process. The figure is the difference of a long and a short run
in CPU time, all processes together, divided by the firings that they differ by: starting costs both the same.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from checkouts import word

HERE = Path(__file__).resolve().parent
CHUNK = 20


@dataclass(frozen=True, slots=True)
class Case:
    """One graph: `operators` without the source, in a chain or a fan; `recorded`: all streams are."""

    name: str
    operators: int
    recorded: bool = False
    fan: bool = False
    live: bool = False
    each: bool = False
    """A process for each operator."""


CASES = (
    Case("chain of 5 relays and a sink", 6),
    Case("the same, recorded", 6, recorded=True),
    Case("chain of 2 operators", 2),
    Case("chain of 8", 8),
    Case("chain of 32", 32),
    Case("chain of 100", 100),
    Case("fan of 2 operators", 2, fan=True),
    Case("fan of 8", 8, fan=True),
    Case("fan of 32", 32, fan=True),
    Case("fan of 100", 100, fan=True),
)


def graph_of(case: Case, count: int, marks: list[int]) -> dict[str, Any]:
    """The graph file of a case."""
    use = "firings_operators:{}".format
    source = {"use": use("Small"), "params": {"count": count}}
    last = {"use": use("Gauge"), "params": {"marks": json.dumps(marks)}}
    operators: dict[str, Any] = {"source": source}
    before = "source"
    for k in range(case.operators - 1):
        operators[f"op{k:03}"] = {"use": use("Take" if case.fan else "Relay"), "inputs": {"x": f"{before}/out"}}
        before = before if case.fan else f"op{k:03}"
    operators["last"] = {**last, "inputs": {"x": f"{before}/out"}}
    return {"graph": "firings", "operators": operators}


def measure(case: Case, tree: Path, count: int, marks: list[int] | None = None) -> dict[str, float]:
    """Runs a case with the code in `tree`; firings, CPU time (µs) a firing, firings per second, memory (MiB)."""
    with tempfile.TemporaryDirectory() as folder:
        graph = Path(folder) / "graph.yaml"
        graph.write_text(json.dumps(graph_of(case, count, marks or [])))  # JSON is YAML
        placement = word(tree, "--process-each" if case.each else "--one-process")
        command = [sys.executable, "-m", "dataflow.cli.main", "run", str(graph), placement, "--json", "--quiet"]
        command += ["--record", str(Path(folder) / "run.mcap")] if case.recorded else []
        command += ["--live"] if case.live else []
        path = os.pathsep.join([str(tree), str(HERE)])
        environment = {**os.environ, "PYTHONPATH": path}
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=600, check=False, env=environment, cwd=folder
        )
        if done.returncode:
            raise SystemExit(f"{case.name}: {done.stderr.strip() or done.stdout.strip()}")
    found = json.loads(done.stdout)["summaries"]["last"]
    if "wall" not in found:
        raise SystemExit(f"{case.name}: only {found['messages']:.0f} messages")
    return {
        "firings": found["messages"] * case.operators,
        "per_second": case.operators / found["wall"],
        "per_second_best": case.operators / found["wall_best"],
        "cpu": found["cpu"] / case.operators * 1e6,
        "cpu_best": found["cpu_best"] / case.operators * 1e6,
        "peak": found["peak"],
        **{f"memory after {n}": mib for n, mib in json.loads(found["memory"]).items()},
    }


def spent_apart(case: Case, count: int) -> float:
    """CPU seconds of all processes of a run with a process for each operator, supervisor and start included."""
    with tempfile.TemporaryDirectory() as folder:
        graph = Path(folder) / "graph.yaml"
        graph.write_text(json.dumps(graph_of(case, count, [])))
        command = [sys.executable, "-m", "dataflow.cli.main", "run", str(graph), "--process-each", "--json", "--quiet"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, capture_output=True, timeout=600, check=True, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def apart(rounds: int, firings: int) -> str:
    """The CPU time of a firing in chains and fans of processes, as Markdown."""
    cases = [
        Case(f"{kind} of {operators}", operators, fan=fan)
        for kind, fan in (("chain", False), ("fan", True))
        for operators in (2, 4, 8, 16)
    ]
    costs: dict[Case, list[float]] = {case: [] for case in cases}
    for _ in range(rounds):
        for case in cases:
            short, long = firings // (4 * case.operators), firings // case.operators
            spent = spent_apart(case, long) - spent_apart(case, short)
            costs[case].append(spent / ((long - short) * case.operators))
    lines = ["| graph | CPU, µs a firing | x that of 2 operators |", "| --- | --- | --- |"]
    for case in cases:
        cost, base = (statistics.median(costs[each]) for each in (case, cases[4 if case.fan else 0]))
        lines.append(f"| {case.name}, a process each | {cost * 1e6:.0f} | {cost / base:.2f} |")
    return "\n".join(lines)


def floor(seconds: float = 1.0) -> dict[str, float]:
    """Firings of the chain of 5 relays and a sink as plain calls."""
    vectors = np.arange(16, dtype=np.float32).reshape(1, 16)
    head, record = struct.Struct("<I13sqs4si"), struct.Struct("<qqqqq")
    log = bytearray()

    def relay(message: dict[str, Any]) -> dict[str, Any]:
        data = vectors.copy()
        data.flags.writeable = False
        return {"stamp": message["stamp"], "vectors": data, "model": ""}

    def digest(message: dict[str, Any]) -> bytes:
        packed = head.pack(13, b"FeatureVector", message["stamp"], b"s", b"", 16)
        return xxhash.xxh3_128_digest(packed + message["vectors"].data)

    messages, spent, until = 0, [], time.monotonic() + seconds
    while time.monotonic() < until:
        began, cpu = time.monotonic(), time.process_time()
        for _ in range(CHUNK):
            messages += 1
            message: dict[str, Any] = {"stamp": messages, "vectors": vectors, "model": ""}
            for k in range(5):
                message = relay(message)
                digest(message)
                log += record.pack(k, messages, messages, messages, 0)
        spent.append((time.monotonic() - began, time.process_time() - cpu))
        log.clear()
    wall, cpu = np.quantile(spent, 0.1, axis=0) / (CHUNK * 6)
    return {"firings": messages * 6, "per_second_best": 1 / wall, "cpu_best": cpu * 1e6}


def compared(rounds: int, cases: list[Case], trees: dict[str, Path], firings: int) -> dict[str, Any]:
    """Every case with every tree, in turns: by case and tree the figures of each round."""
    found: dict[str, Any] = {"floor": {"floor": []}} | {case.name: {name: [] for name in trees} for case in cases}
    for _ in range(rounds):
        found["floor"]["floor"].append(floor())
        for case in cases:
            for name, tree in trees.items():
                found[case.name][name].append(measure(case, tree, firings // case.operators))
    return found


def middle(rounds: list[dict[str, float]], what: str) -> float:
    return statistics.median(figures[what] for figures in rounds)


def table(found: dict[str, Any], trees: dict[str, Path]) -> str:
    """The figures as Markdown; with two trees the ratio of the first to the second."""
    names = list(trees)
    old = len(names) > 1
    lines = [
        f"| graph | firings/s |{' before | ratio of CPU time (smallest - largest) |' if old else ''} CPU, µs a firing |"
        f"{' before |' if old else ''} x that of 2 operators |",
        "| --- | --- |" + (" --- | --- |" if old else "") + " --- |" + (" --- |" if old else "") + " --- |",
    ]
    two = {kind: found.get(f"{kind} of 2 operators", {}).get(names[0]) for kind in ("chain", "fan")}
    for case, by_tree in found.items():
        mine = by_tree.get(names[0]) or by_tree["floor"]
        cells = [case, f"{middle(mine, 'per_second_best'):,.0f}"]
        if old:
            before = by_tree.get(names[1])
            ratios = [b["cpu_best"] / a["cpu_best"] for a, b in zip(mine, before or [], strict=False)]
            text = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} - {max(ratios):.2f})" if ratios else ""
            cells += [f"{middle(before, 'per_second_best'):,.0f}" if before else "", text]
        cells.append(f"{middle(mine, 'cpu_best'):.1f}")
        if old:
            cells.append(f"{middle(before, 'cpu_best'):.1f}" if before else "")
        base = two.get(case.split()[0])
        cells.append(f"{middle(mine, 'cpu_best') / middle(base, 'cpu_best'):.2f}" if base and " of " in case else "")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def memory(tree: Path) -> str:
    """The memory of one process after 100,000 and after 1,000,000 messages through two operators."""
    figures = measure(Case("memory", 2), tree, 1_000_000, [10_000, 100_000, 1_000_000])
    after, end = figures["memory after 100000"], figures["memory after 1000000"]
    return f"memory after 100,000 messages {after:.1f} MiB, after 1,000,000 {end:.1f} MiB: {end / after:.3f} x"


def processes(rounds: int, trees: dict[str, Path], messages: int) -> str:
    """Messages per second, end to end, through a chain with a process for each operator, as Markdown."""
    chain = Case("chain of 5 relays and a sink, a process each", 6, each=True)
    cases = chain, replace(chain, name="the same, all streams recorded", recorded=True)
    found: dict[str, dict[str, list[float]]] = {case.name: {name: [] for name in trees} for case in cases}
    for _ in range(rounds):
        for case in cases:
            for name, tree in trees.items():
                found[case.name][name].append(measure(case, tree, messages)["per_second"] / case.operators)
    lines = [f"| messages/s | {' | '.join(trees)} |", "| --- |" + " --- |" * len(trees)]
    for which, by_tree in found.items():
        texts = [f"{statistics.median(each):,.0f} ({min(each):,.0f} - {max(each):,.0f})" for each in by_tree.values()]
        lines.append(f"| {which} | {' | '.join(texts)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--firings", type=int, default=40_000, help="how many each graph makes")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--against", type=Path, help="the root of another checkout")
    parser.add_argument("--only", default="", help="cases whose name holds one of these words, separated by commas")
    parser.add_argument("--live", action="store_true", help="live runs")
    parser.add_argument("--memory", action="store_true", help="memory after many messages, instead")
    parser.add_argument("--processes", action="store_true", help="messages/s of a process each, instead")
    parser.add_argument("--apart", action="store_true", help="CPU time where each operator has a process, instead")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.apart:
        print(apart(arguments.rounds, arguments.firings))
        return
    if arguments.memory:
        print(memory(HERE.parent))
        return
    trees = {"now": HERE.parent} | ({"before": arguments.against.resolve()} if arguments.against else {})
    if arguments.processes:
        print(processes(arguments.rounds, trees, arguments.firings // 8))
        return
    words = arguments.only.split(",")
    cases = [replace(case, live=arguments.live) for case in CASES if any(word in case.name for word in words)]
    found = compared(arguments.rounds, cases, trees, arguments.firings)
    print(json.dumps(found) if arguments.json else table(found, trees))


if __name__ == "__main__":
    main()
