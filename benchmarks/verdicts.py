"""Are the verdicts on hard operators right? Runs the zoo in all ways, verifies each recording, and prints a table.

python benchmarks/verdicts.py [--only WORD] [--ways run live killed]

Columns are the ways: run, live, or live and killed (SIGKILL to the supervisor), each with a process per operator and
with one process for all. A cell is the verdict, with `!` where another one would be right. Exit code 1 if one is wrong.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
SUPPORT = REPOSITORY / "tests" / "support"
sys.path.append(str(SUPPORT))

from zoo.cages import AT_THE_END, CAGES, Cage  # noqa: E402
from zoo.operators import STEPS  # noqa: E402

from dataflow.recording import Recording, RecordingError  # noqa: E402
from dataflow.records.reading import FiringLog  # noqa: E402
from dataflow.verification.verify import verify  # noqa: E402

WAYS = ("run", "live", "killed")
PLACEMENTS = {"each": "process_each", "one": "one_process"}
WITHIN = 120.0
"""Seconds within which a run is over, or has recorded what it is killed for."""
RECORDED = 10**18 + 1_500_000_000
"""The stamp (ns) up to which each operator has recorded calls when its run is killed: behind its first two states."""
LONG = 100_000
"""Steps of a run that is killed: half an hour."""

RUN = """
import sys
sys.path.append({support!r})
from pathlib import Path
from zoo.cages import CAGES
from dataflow.supervision.run import run
run(CAGES[{cage!r}].graph({steps}), placement={placement!r}, record=Path({path!r}), live={live!r})
"""


def record(name: str, way: str, placement: str, path: Path) -> str:
    """Records a run of a cage in a process; that is killed when all its operators have recorded calls, if asked for.

    Returns why there is nothing to judge, or nothing.
    """
    made = {"support": str(SUPPORT), "cage": name, "path": str(path), "live": way != "run"}
    steps = LONG if way == "killed" else STEPS
    program = RUN.format(placement=PLACEMENTS[placement], steps=steps, **made)
    with subprocess.Popen(
        [sys.executable, "-c", program], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    ) as running:
        deadline, due = time.monotonic() + WITHIN, False
        while running.poll() is None and not due and time.monotonic() < deadline:
            time.sleep(0.5)
            due = way == "killed" and all(s > RECORDED for s in _recorded(path, CAGES[name].operators).values())
        ended = running.poll() is not None
        running.kill()
    if way == "killed":
        return "" if due else "ended before it was killed" if ended else f"not recorded within {WITHIN:g} s"
    return "" if ended else f"not over within {WITHIN:g} s"


def _recorded(path: Path, operators: Iterable[str]) -> Mapping[str, int]:
    """The last stamp that each operator has recorded; 0 for none."""
    try:
        with Recording(path) as recording:
            log = FiringLog.read(recording)
            return {o: max((record.stamp for record in log.of(o)), default=0) for o in operators}
    except RecordingError:  # not there yet
        return dict.fromkeys(operators, 0)


def verdicts(path: Path) -> Mapping[str, str]:
    """The verdict on each operator of a recording of which a call was verified."""
    report = verify(path)
    return {v.operator: report.verdict(v) if v.verified else "nothing verified" for v in report.operators}


def right(cage: Cage, way: str, placement: str) -> Mapping[str, str]:
    verdicts = cage.verdicts if placement == "each" else cage.together
    return {
        o: "identical" if way == "killed" and use in AT_THE_END else verdicts[o]
        for o, (use, _) in cage.operators.items()
    }


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
                fault = record(name, way, placement, Path(folder) / "run.mcap")
                judged = {} if fault else verdicts(Path(folder) / "run.mcap")
                found[way, placement] = {o: judged.get(o, fault or "no verdict") for o in cage.operators}
        for operator, (use, _) in cage.operators.items():
            cells = []
            for way, placement in columns:
                verdict = found[way, placement][operator]
                mistaken = verdict != right(cage, way, placement)[operator]
                wrong, total = wrong + mistaken, total + 1
                cells.append(f"{'! ' if mistaken else ''}{verdict} |")
            print(f"| {use} ({operator}, {name}) |" if use != operator else f"| {use} |", *cells, flush=True)
    print(f"\n{total - wrong} of {total} verdicts are right")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
