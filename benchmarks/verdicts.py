"""Are the verdicts on hard operators right? Runs the zoo in all ways, verifies each recording, and prints a table.

python benchmarks/verdicts.py [--only WORD] [--ways run live killed]

Columns are the ways: run, live, or live and killed (SIGKILL to the supervisor), each with a process per operator and
with one process for all. A cell is the verdict, with `!` where another one would be right. Exit code 1 if one is wrong.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
SUPPORT = REPOSITORY / "tests" / "support"
sys.path.append(str(SUPPORT))

from zoo.cages import CAGES, Cage  # noqa: E402

from dataflow.verification.verify import verify  # noqa: E402

WAYS = ("run", "live", "killed")
PLACEMENTS = {"each": "process_each", "one": "one_process"}
STARTED_WITHIN = 120.0
RECORDS = 60_000
"""Bytes of a recording after which its run is killed."""

RUN = """
import sys
sys.path.append({support!r})
from pathlib import Path
from zoo.cages import CAGES
from dataflow.supervision.run import run
run(CAGES[{cage!r}].graph(), placement={placement!r}, record=Path({path!r}), live={live!r})
"""


def record(name: str, way: str, placement: str, path: Path) -> None:
    """Records a run of a cage in a process; that is killed when it has written for a while, if asked for."""
    made = {"support": str(SUPPORT), "cage": name, "path": str(path), "live": way != "run"}
    program = RUN.format(placement=PLACEMENTS[placement], **made)
    with subprocess.Popen(
        [sys.executable, "-c", program], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    ) as running:
        deadline = time.monotonic() + STARTED_WITHIN
        while way == "killed" and running.poll() is None and time.monotonic() < deadline:
            if path.exists() and path.stat().st_size > RECORDS:
                os.kill(running.pid, signal.SIGKILL)
                break
            time.sleep(0.02)
        running.communicate(timeout=STARTED_WITHIN)


def verdicts(path: Path) -> Mapping[str, str]:
    """The verdict on each operator of a recording."""
    report = verify(path)
    return {v.operator: report.verdict(v) for v in report.operators}


def right(cage: Cage, placement: str) -> Mapping[str, str]:
    return cage.verdicts if placement == "each" else cage.together


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cages whose names hold this word")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    chosen = parser.parse_args()
    columns = [(way, placement) for way, placement in itertools.product(chosen.ways, PLACEMENTS)]
    print("| operator |", *(f"{way}, {placement} |" for way, placement in columns))
    print("| --- |", *("--- |" for _ in columns))
    wrong = total = 0
    for name, cage in CAGES.items():
        if chosen.only not in name:
            continue
        found = {}
        for way, placement in columns:
            with tempfile.TemporaryDirectory() as folder:
                record(name, way, placement, Path(folder) / "run.mcap")
                found[way, placement] = verdicts(Path(folder) / "run.mcap")
        for operator, (use, _) in cage.operators.items():
            cells = []
            for way, placement in columns:
                verdict = found[way, placement][operator]
                mistaken = verdict != right(cage, placement)[operator]
                wrong, total = wrong + mistaken, total + 1
                cells.append(f"{'! ' if mistaken else ''}{verdict} |")
            print(f"| {use} ({operator}, {name}) |" if use != operator else f"| {use} |", *cells, flush=True)
    print(f"\n{total - wrong} of {total} verdicts are right")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
