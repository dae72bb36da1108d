"""Sweeps of the bundled recording's parts: one core against two, a second sweep against the first.

usage: python benchmarks/sweep.py [--parts 10]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
DATAFLOW = (sys.executable, "-m", "dataflow.cli.start")


def call(*words: object) -> str:
    """Runs a command; returns what it printed. Raises `CalledProcessError`."""
    command = [*DATAFLOW, *map(str, words)]
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=REPOSITORY).stdout


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--parts", type=int, default=10)
    parts = options.parse_args().parts
    with tempfile.TemporaryDirectory() as folder:
        runs, pieces = Path(folder) / "runs", Path(folder) / "pieces"
        call("split", "recordings/demo.mcap", "--every", f"{21 / parts}s", "--out", pieces)
        for piece in sorted(pieces.glob("*.mcap")):  # apart, or they would be one recording
            (runs / piece.stem).mkdir(parents=True)
            piece.rename(runs / piece.stem / "run.mcap")
        print("| sweep | runs | s |\n| --- | ---: | ---: |")
        took = {}
        for name, jobs, out in (("one core", 1, "one"), ("two cores", 2, "two"), ("two cores, again", 2, "two")):
            begun = time.monotonic()
            words = ("--recordings", runs, "--out", Path(folder) / out, "--jobs", jobs, "--json", "--quiet")
            told = json.loads(call("sweep", "graphs/cloud.yaml", *words))
            took[name] = time.monotonic() - begun
            print(f"| {name} | {told['ran']} | {took[name]:.1f} |")
        print(f"\ntwo cores are {took['one core'] / took['two cores']:.2f} times as quick as one")
        print(f"a second sweep takes {took['two cores, again'] / took['two cores']:.1%} of the first")


if __name__ == "__main__":
    main()
