"""The engine on a simulated machine: one scenario for each of the requested seeds.

usage: python benchmarks/simulation.py [--seeds 1000] [--from 0] [--jobs 2] [--links] [--json]
       python benchmarks/simulation.py --mutants [--seeds 2000]

Every seed: a small graph, recorded, in one process or one each, live or not, on a machine that is slow or quick, under
kills, freezes, faults, stops and a disk that is slow or full; then its recording is verified, and
replayed. All of it runs in one thread on simulated time: supervisor, processes, aligners, flow control, recorder and
verification are those that ship. What must hold: tests/support/simulation/check.py. A seed that breaks a promise is
shrunk, and its plan is printed; exit code 1.

With --links, a seed is instead what two machines say to each other over a link that is delayed, throttled, stalled and
reset (tests/support/simulation/pipes.py).

With --mutants, faults are planted in the engine, one at a time, and it is counted how many seeds find each.

Needs the package greenlet (`pip install -e '.[dev]'`).
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]
MEMORY = Path("/dev/shm")
CHUNK, CHUNKS = 10, 10
"""Seeds that a process is given at a time, and how often: a seed leaves 2.5 MB of garbage."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Runs the engine on a simulated machine.")
    parser.add_argument("--seeds", type=int, default=1000, help="how many (with --mutants: at most, for each)")
    parser.add_argument("--from", type=int, default=0, dest="first", help="the first one")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes that share them")
    parser.add_argument("--links", action="store_true", help="two machines and their link, instead of runs")
    parser.add_argument("--mutants", action="store_true", help="plant faults, and count the seeds that find each")
    parser.add_argument("--only", help="with --mutants: this one")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    options = parser.parse_args()
    if os.environ.get("PYTHONHASHSEED") != "0":  # a seed gives the same run everywhere
        os.environ |= {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        os.execv(sys.executable, [sys.executable, *sys.argv])
    return _mutants(options) if options.mutants else _seeds(options)


# Seeds


def _seeds(options: argparse.Namespace) -> int:
    begun = time.monotonic()
    found: Counter[str] = Counter()
    totals: Counter[str] = Counter()
    failures = []
    for number, result in enumerate(_results(options), start=1):
        found[result["verdict"]] += 1
        totals.update(result["counts"])
        if result["violation"]:
            failures.append(result)
            if not options.json:
                _show_failure(result)
        if not options.json and sys.stderr.isatty():
            _show_progress(number, options.seeds, time.monotonic() - begun, len(failures))
    wall = time.monotonic() - begun
    summary = {
        "seeds": options.seeds,
        "from": options.first,
        "jobs": options.jobs,
        "wall_s": round(wall, 1),
        "seeds_per_minute": round(60 * options.seeds / wall),
        "verdicts": dict(sorted(found.items())),
        **totals,
    }
    if options.json:
        print(json.dumps(summary | {"failures": failures}))
    else:
        _show_summary(summary, len(failures))
    return 1 if failures else 0


def _results(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    seeds = range(options.first, options.first + options.seeds)
    one = _link if options.links else _one
    _load()
    with multiprocessing.get_context("fork").Pool(options.jobs, gc.disable, maxtasksperchild=CHUNKS) as pool:
        yield from pool.imap_unordered(one, seeds, chunksize=CHUNK)


def _load() -> None:
    """Has in memory what every process needs that runs seeds: none of them collects garbage, and each is over soon."""
    from simulation.bindings import load
    from simulation.check import check
    from simulation.scenario import scenario_of

    load()
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:  # others may run seed 0 meanwhile
        check(scenario_of(0), Path(folder))
    gc.collect()
    gc.freeze()


def _link(seed: int) -> dict[str, Any]:
    """Runs one link; the result as plain values."""
    from simulation.pipes import journey_of, shrunk, travel
    from simulation.world import Violation

    journey = journey_of(seed)
    counts = {"frames": sum(map(len, journey.sent)), "resets": sum(e.kind == "reset" for e in journey.events)}
    try:
        travel(journey)
    except Violation as violation:
        small, said = shrunk(journey, violation)
        return {"seed": seed, "verdict": "broken", "violation": said, "plan": str(small), "counts": {}}
    return {"seed": seed, "verdict": "everything was taken", "violation": "", "plan": "", "counts": counts}


def _one(seed: int) -> dict[str, Any]:
    """Runs one seed; the result as plain values."""
    from simulation.check import check
    from simulation.scenario import scenario_of
    from simulation.shrink import shrink
    from simulation.world import Violation

    scenario = scenario_of(seed)
    folder = _memory() / f"simulated-{seed}"  # it is told in recordings: a seed gives the same bytes each time
    folder.mkdir(exist_ok=True)
    try:
        result = check(scenario, folder)
    except Violation as violation:
        small, said = shrink(scenario, folder, violation)
        plan = small.describe()
        return {"seed": seed, "verdict": "broken", "violation": said, "plan": plan, "counts": {}}
    finally:
        shutil.rmtree(folder)
    outcome = result.outcome
    verdict = result.verdict + (", the run failed" if outcome.failure is not None else "")
    counts: dict[str, Any] = {
        "simulated_s": round(outcome.seconds, 3),
        "live": int(scenario.live),
        "killed": len(outcome.killed),
        "restarts": sum(outcome.report.restarts.values()) if outcome.report is not None else 0,
        "drops": result.drops,
        "replayed": int(result.replayed),
    }
    return {"seed": seed, "verdict": verdict, "violation": "", "plan": "", "counts": counts}


def _memory() -> Path:
    """A file system in memory, where there is one."""
    return MEMORY if MEMORY.is_dir() else Path(tempfile.gettempdir())


def _show_failure(result: dict[str, Any]) -> None:
    print(f"\nseed {result['seed']} breaks a promise: {result['violation']}\nshrunk to {result['plan']}", flush=True)


def _show_progress(number: int, of: int, seconds: float, failures: int) -> None:
    filled = 40 * number // of
    left = seconds / number * (of - number)
    print(
        f"\r{'█' * filled}{'·' * (40 - filled)} {number}/{of}, {60 * number / seconds:.0f} a minute, "
        f"{left:.0f} s left, {failures} broken ",
        end="",
        file=sys.stderr,
        flush=True,
    )


def _show_summary(summary: dict[str, Any], failures: int) -> None:
    print(
        f"\n{summary['seeds']} seeds from {summary['from']}, {summary['wall_s']} s with {summary['jobs']} jobs "
        f"({summary['seeds_per_minute']} a minute): {failures} break a promise"
    )
    print("\n| outcome | seeds |\n| --- | --- |")
    for verdict, number in summary["verdicts"].items():
        print(f"| {verdict} | {number} |")
    names = ("live", "killed", "restarts", "drops", "replayed", "simulated_s", "frames", "resets")
    print("\n" + ", ".join(f"{name} {summary[name]:g}" for name in names if name in summary))


# Mutants


def _mutants(options: argparse.Namespace) -> int:
    from simulation.mutants import MUTANTS

    names = [options.only] if options.only else list(MUTANTS)
    tasks = [(name, options.first, options.seeds) for name in names]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        found = list(pool.imap(_find, tasks))
    if options.json:
        print(json.dumps(found))
        return 0 if all(each["seeds"] for each in found) else 1
    print("| planted | seeds to find it | seconds | the shrunk plan breaks |\n| --- | --- | --- | --- |")
    for each in found:
        print(f"| {each['said']} | {each['seeds'] or 'not found'} | {each['wall_s']} | {each['violation']} |")
    for each in found:
        print(f"\n{each['said']}:\n\n```text\n{each['plan']}\n```")
    return 0 if all(each["seeds"] for each in found) else 1


def _find(task: tuple[str, int, int]) -> dict[str, Any]:
    """Counts the seeds that it takes until a planted fault is found."""
    from simulation.check import check
    from simulation.mutants import MUTANTS
    from simulation.scenario import scenario_of
    from simulation.shrink import shrink
    from simulation.world import Violation

    name, first, most = task
    if name == "link":
        return _find_link(first, most)
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(dir=_memory()) as folder, MUTANTS[name].planted():
        for seed in range(first, first + most):
            scenario = scenario_of(seed)
            try:
                check(scenario, Path(folder), replay=MUTANTS[name].replays)
            except Violation as violation:
                wall = round(time.monotonic() - begun, 1)
                small, said = shrink(scenario, Path(folder), violation)
                return {
                    "name": name,
                    "said": MUTANTS[name].said,
                    "seeds": seed - first + 1,
                    "wall_s": wall,
                    "violation": said.splitlines()[0],
                    "plan": small.describe(),
                }
    wall = round(time.monotonic() - begun, 1)
    return {"name": name, "said": MUTANTS[name].said, "seeds": 0, "wall_s": wall, "violation": "", "plan": ""}


def _find_link(first: int, most: int) -> dict[str, Any]:
    from simulation.mutants import MUTANTS

    begun = time.monotonic()
    mutant = MUTANTS["link"]
    with mutant.planted():
        results = map(_link, range(first, first + most))
        found = next((result for result in results if result["violation"]), None)
    wall = round(time.monotonic() - begun, 1)
    shown = {"violation": "", "plan": ""} if found is None else {k: found[k] for k in ("violation", "plan")}
    return {
        "name": "link",
        "said": mutant.said,
        "seeds": 0 if found is None else found["seed"] - first + 1,
        "wall_s": wall,
        **shown,
    }


if __name__ == "__main__":
    sys.exit(main())
