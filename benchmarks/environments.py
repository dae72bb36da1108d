"""What does an operator in another environment cost at the start, and is another numpy named? Prints a table.

python benchmarks/environments.py [--rounds 3]

Builds environments with numpy 1.26.4 from the package index, runs a graph of a source and two operators in none of
them, with one operator in one and with each in another, and gives the least time of `dataflow run` and its CPU time.
Then numpy is brought to this installation's version in one, and `dataflow verify` has to name it. Exit code 1 where an
environment costs more than 1 s of CPU time, or the change is not named.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

OPERATORS = """\
import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source


class Count(Source):
    count: Out[FeatureVector]

    def stream(self):
        for k in range(100):
            yield {"count": FeatureVector(stamp=k, model="m", labels=("x",), vectors=np.full((1, 1), k, np.float32))}


class Double(Operator):
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x):
        return x.replace(vectors=2 * x.vectors)
"""
GRAPH = """\
graph: environments
operators:
  count: {use: "counted:Count"}
  first: {use: "counted:Double", inputs: {x: count/count}FIRST}
  second: {use: "counted:Double", inputs: {x: first/y}SECOND}
"""
OLD = "1.26.4"
MOST = 1.0


def main() -> int:
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--rounds", type=int, default=3, help="runs of each graph")
    rounds = arguments.parse_args().rounds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "counted.py").write_text(OPERATORS)
        for env in ("one", "two"):
            (folder / f"{env}.txt").write_text(f"numpy=={OLD}\n")
        graphs = {"none": ("", ""), "one": (", env: one.txt", ""), "two": (", env: one.txt", ", env: two.txt")}
        for label, (first, second) in graphs.items():
            (folder / f"{label}.yaml").write_text(GRAPH.replace("FIRST", first).replace("SECOND", second))
        dataflow(folder, "env", "two.yaml")
        print("| environments | run, s | CPU, s |\n| --- | ---: | ---: |")
        cpu = {}
        for label in graphs:
            dataflow(folder, "run", f"{label}.yaml", "--quiet")  # bytecode is written
            took = [timed(folder, label) for _ in range(rounds)]
            wall, cpu[label] = (min(each) for each in zip(*took, strict=True))
            print(f"| {label} | {wall:.2f} | {cpu[label]:.2f} |")
        dataflow(folder, "verify", "one.mcap", "--quiet")
        (folder / "one.txt").write_text(f"numpy=={np.__version__}\n")
        dataflow(folder, "env", "one.yaml")
        change = f"numpy {OLD} -> {np.__version__}"
        named = change in dataflow(folder, "verify", "one.mcap", codes=(0, 1))
    print(f"verified in the environment; named afterwards: {change}: {named}")
    return int(not named or cpu["two"] - cpu["none"] > 2 * MOST)


def timed(folder: Path, label: str) -> tuple[float, float]:
    """Returns the wall and CPU seconds of a run that is recorded."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    dataflow(folder, "run", f"{label}.yaml", "--quiet", "--record", f"{label}.mcap", "--overwrite")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - began, used


def dataflow(folder: Path, *words: str, codes: tuple[int, ...] = (0,)) -> str:
    """Returns what the command prints. Raises SystemExit where it ends with another exit code."""
    command = [sys.executable, "-m", "dataflow.cli.start", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode not in codes:
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return " ".join((done.stdout + done.stderr).split())


if __name__ == "__main__":
    sys.exit(main())
