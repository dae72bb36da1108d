"""Seconds to the first message or table: a graph started, a tool attached, a recording replayed or verified.

    python benchmarks/start.py
    python benchmarks/start.py --against OTHER_TREE     # another checkout in turns with this one: ratios
    python benchmarks/start.py --only attach,first

Each figure is taken from the start of the command, Python's own start included, with compiled modules (a first run
makes them). `first message`: until the sink of a graph of seven light operators, a process each, gets one. `echo`,
`hz`, `view` attach to such a graph while it runs: until the first line, the first table (on a terminal), and until
the viewer file follows it. Replays and verifications are of recordings/demo.mcap through graphs/simulated_robot.yaml:
`start and close` is what the command takes beyond its sources' and operators' run; efficiency is the CPU time of the
operators' calls divided by that run's time, and by the cores that it may use.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pty
import resource
import select
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from checkouts import word

HERE = Path(__file__).resolve().parent
RELAYS = 5
GRAPH = "graphs/simulated_robot.yaml"
DEMO = "recordings/demo.mcap"
WAIT = 30.0

Figures = dict[str, float]


def light_graph(folder: Path, count: int) -> Path:
    """Writes a graph of seven light operators, which makes so many messages."""
    operators: dict[str, Any] = {"source": {"use": "start_operators:Steady", "params": {"count": count}}}
    before = "source"
    for k in range(RELAYS):
        operators[f"relay{k}"] = {"use": "start_operators:Pass", "inputs": {"x": f"{before}/out"}}
        before = f"relay{k}"
    operators["last"] = {"use": "start_operators:First", "inputs": {"x": f"{before}/out"}}
    path = folder / "light.yaml"
    path.write_text(json.dumps({"graph": "light", "operators": operators}))  # JSON is YAML
    return path


class Tree:
    """A checkout whose command is measured, with a separate folder of running graphs."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = root, folder
        self.environment = {
            **{name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
            "PYTHONPATH": os.pathsep.join([str(root), str(HERE)]),
            "XDG_RUNTIME_DIR": str(folder),
        }

    def command(self, *words: object) -> list[str]:
        return [sys.executable, "-P", "-m", "dataflow.cli.main", *(word(self.root, str(w)) for w in words)]

    def call(self, *words: object) -> tuple[dict[str, Any], float, float]:
        """Runs a command to its end: its JSON, when it was started, and the seconds it took."""
        began = time.monotonic()
        done = subprocess.run(
            self.command(*words),
            env=self.environment,
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=150,
            check=False,
        )
        if done.returncode:
            raise SystemExit(f"{' '.join(map(str, words))}: {done.stderr.strip()}")
        return json.loads(done.stdout), began, time.monotonic() - began

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """A light graph that runs meanwhile."""
        graph = light_graph(self.folder, 1_000_000)
        command = self.command("run", graph, "--live", "--process-each", "--quiet")
        with subprocess.Popen(command, env=self.environment, cwd=self.folder, stdout=subprocess.DEVNULL) as process:
            try:
                seen_within(self, "echo", "source/out", "--wait", WAIT, until=b"FeatureVector")
                yield
            finally:
                process.terminate()


def cpu_of_ended() -> float:
    """CPU seconds of all processes that this one has started and that have ended: hardly moved by other work."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def seen_within(tree: Tree, *words: object, until: bytes) -> float:
    """Seconds from the start of a command until it has printed `until` on a terminal; it is ended then."""
    reading, writing = pty.openpty()
    began = time.monotonic()
    process = subprocess.Popen(
        tree.command(*words),
        env=tree.environment,
        cwd=tree.folder,
        stdin=subprocess.DEVNULL,
        stdout=writing,
        stderr=writing,
    )
    os.close(writing)
    said = b""
    try:
        while until not in said:
            left = began + WAIT - time.monotonic()
            if left <= 0 or not select.select([reading], [], [], left)[0]:
                raise SystemExit(f"{words[0]} did not print {until!r}: {said.decode(errors='replace')}")
            said += os.read(reading, 4096)
        return time.monotonic() - began
    finally:
        process.kill()
        process.wait()
        os.close(reading)


def first_message(tree: Tree) -> Figures:
    """Starts a graph of seven processes."""
    spent = cpu_of_ended()
    report, began, took = tree.call("run", light_graph(tree.folder, 20), "--process-each", "--quiet", "--json")
    return {
        "first message of seven processes": report["summaries"]["last"]["first"] - began,
        "the same: start and close": took - report["wall_s"],
        "the same: CPU time of the whole run": cpu_of_ended() - spent,
    }


def attach(tree: Tree) -> Figures:
    """Attaches each tool to a graph that runs."""
    file = tree.folder / "seen.rrd"
    tools = {
        "`echo`: first message": (("echo", "source/out"), b"FeatureVector"),
        "`hz`: first table": (("hz",), b"MB/s"),
        "`view`: attached": (("view", "--to", file, "--overwrite"), b"following"),
    }
    figures = {}
    with tree.running():
        for name, (words, until) in tools.items():
            spent = cpu_of_ended()
            figures[name] = seen_within(tree, *words, until=until)
            figures[f"{name.partition(':')[0]}: CPU time until then"] = cpu_of_ended() - spent
    return figures


def replay(tree: Tree) -> Figures:
    """Replays the demo in its placement, in one process, and from its middle."""
    figures = {}
    for name, cores, words in (("replay", 2, ()), ("replay, one process", 1, ("--one-process",))):
        report, _, took = tree.call(
            "replay", tree.root / DEMO, "--graph", tree.root / GRAPH, "--quiet", "--json", *words
        )
        work = sum(operator["cpu_ms"] for operator in report["operators"].values()) / 1e3
        figures[f"{name}: start and close"] = took - report["wall_s"]
        figures[f"{name}: operators' work"] = work
        figures[f"{name}: efficiency"] = work / (cores * report["wall_s"])
    return figures


def verify(tree: Tree) -> Figures:
    """Verifies a full recording of 20 s, whole and from near its end, where operators take up a snapshot."""
    full = recorded(tree, "full", "")
    report, _, whole = tree.call("verify", full, "--json", "--quiet")
    figures = {"verify": whole}
    if "reading_cpu_ms" in report:
        work = (report["reading_cpu_ms"] + sum(operator["cpu_ms"] for operator in report["operators"])) / 1e3
        figures |= {"verify: work": work, "verify: efficiency": work / (2 * report["wall_s"])}
    late = "verify the last second of the perception"
    only = [word for name in ("odometry", "detector", "segmenter", "cloud") for word in ("--only", name)]
    for snapshots, name in (("", "without snapshots"), (", snapshots: 5s", "with one every 5 s")):
        file = recorded(tree, f"full{bool(snapshots):d}", snapshots)
        report, _, took = tree.call("verify", file, "--json", "--quiet", "--start", "20", *only)
        figures |= {f"{late}, {name}": took, f"{late}, {name}: repeating": report["wall_s"]}
    return figures


def recorded(tree: Tree, name: str, snapshots: str) -> Path:
    """Replays the demo and records everything; `snapshots` is added to the graph's `record` section."""
    file = tree.folder / f"{name}.mcap"
    if not file.exists():
        text = (tree.root / GRAPH).read_text()
        assert "depth/depth]}" in text
        graph = tree.folder / f"{name}.yaml"
        graph.write_text(text.replace("depth/depth]}", f"depth/depth]{snapshots}}}"))
        tree.call("replay", tree.root / DEMO, "--graph", graph, "--quiet", "--json", "--record", file)
    return file


MEASURES: Mapping[str, Callable[[Tree], Figures]] = {
    "first": first_message,
    "attach": attach,
    "replay": replay,
    "verify": verify,
}


def table(rounds: Mapping[str, list[Figures]]) -> str:
    """The medians as Markdown; with two trees the ratio of the first to the second, and its spread."""
    now, *before = rounds
    lines = ["| | now |" + (" before | ratio (smallest - largest) |" if before else ""), "| --- | --- |"]
    lines[1] += " --- | --- |" if before else ""
    for name in rounds[now][0]:
        cells = [name, f"{statistics.median(each[name] for each in rounds[now]):.2f}"]
        for other in before:
            if not all(name in each for each in rounds[other]):
                cells += ["", ""]
                continue
            ratios = [mine[name] / theirs[name] for mine, theirs in zip(rounds[now], rounds[other], strict=True)]
            cells.append(f"{statistics.median(each[name] for each in rounds[other]):.2f}")
            cells.append(f"{statistics.median(ratios):.2f} ({min(ratios):.2f} - {max(ratios):.2f})")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--against", type=Path, help="the root of another checkout")
    parser.add_argument("--only", default=",".join(MEASURES), help=f"some of {', '.join(MEASURES)}")
    arguments = parser.parse_args()
    roots = {"now": HERE.parent} | ({"before": arguments.against.resolve()} if arguments.against else {})
    with tempfile.TemporaryDirectory() as folder:
        trees = {}
        for name, root in roots.items():
            (own := Path(folder) / name).mkdir(mode=0o700)
            trees[name] = Tree(root, own)
            first_message(trees[name])  # compiles modules
        for measure in arguments.only.split(","):
            rounds: dict[str, list[Figures]] = {name: [] for name in trees}
            for _ in range(arguments.rounds):
                for name, tree in trees.items():
                    rounds[name].append(MEASURES[measure](tree))
            print(table(rounds), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
