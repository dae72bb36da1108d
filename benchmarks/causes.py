"""Does `verify --why` find the causes in operators that do not repeat, and none in those that do? Prints a table.

python benchmarks/causes.py [--only OPERATOR ...] [--sound | --wild]

A zoo of faulty operators is recorded by one process and verified by others, where a file and a variable of the
environment have changed. With `--sound`, the operators of `tests/support/zoo` that repeat are asked about as if they
did not, and as if they differed alike each time: no cause may be named. With `--wild`, registrations of kiss-icp,
small_gicp and Open3D are asked about, as far as these are installed. Exit code 1 if an answer is wrong.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
SUPPORT = REPOSITORY / "tests" / "support"
sys.path.append(str(SUPPORT))

from zoo.cages import REPEATS  # noqa: E402

from dataflow.causes import sources  # noqa: E402
from dataflow.causes.why import CauseReport, why  # noqa: E402
from dataflow.records.comparison import Difference  # noqa: E402
from dataflow.verification.report import VerifyReport  # noqa: E402
from dataflow.verification.verify import verify  # noqa: E402

FAULTY = {
    "Wall": {sources.WALL},
    "Monotonic": {sources.MONOTONIC},
    "Compiled": {sources.COMPILED},
    "Reseeded": {sources.RANDOM},
    "Loaded": {sources.RANDOM},
    "Numpy": {sources.NUMPY},
    "Identifier": {sources.UUID},
    "Bytes": {sources.ENTROPY},
    "Hashes": {sources.HASHES},
    "Identities": {sources.IDENTITY},
    "Addresses": {sources.ADDRESSES},
    "Threads": {sources.THREADS},
    "Empty": {sources.HEAP},
    "FromFile": {sources.FILE},
    "FromVariable": {sources.VARIABLE},
    "Writes": {sources.INPUT},
    "Leaves": {sources.MODULE},
    "Two": {sources.WALL, sources.ENTROPY},
    "ClockAndMemory": {sources.WALL, sources.HEAP},
    "Sets, repeats": {sources.HASHES},
}
"""The kinds of causes of each operator of `zoo.faulty`; and of one that repeats only since every run fixes hashes."""
WILD = {
    f"{library}{threads}": f"use: 'causes_operators:{library}', params: {{threads: {threads}}}"
    for library in ("KissIcp", "SmallGicp", "Open3dIcp")
    for threads in (1, 4)
}
"""Registrations by name: class, and number of threads."""
RUN = """
import sys
sys.path += {folders!r}
import dataflow
from dataflow.graph import load_text
from dataflow.supervision.core.report import RunFailed
for path, text in {runs!r}.items():
    try:
        dataflow.run(load_text(text), record=path)
    except RunFailed as failure:  # one that fails to close
        print(failure, file=sys.stderr)
"""
UNTRAPPED = {sources.COMPILED, sources.HASHES, sources.ADDRESSES, sources.MODULE}
"""Kinds for which no line can be named."""


def recorded(folder: Path, operators: dict[str, str]) -> dict[str, Path]:
    """A run of each operator by name (class and parameters), all in one process, with another environment."""
    paths, runs = {name: folder / f"{name}.mcap" for name in operators}, {}
    for name, use in operators.items():
        lines = ["graph: zoo", "operators:", "  src: {use: 'zoo.operators:Steps', params: {steps: 12}}"]
        runs[str(paths[name])] = "\n".join([*lines, f"  {name}: {{{use}, inputs: {{x: src/out}}}}"])
    environment = {**os.environ, "PYTHONHASHSEED": "7", "ZOO_GAIN": "2"}
    program = [sys.executable, "-c", RUN.format(folders=[str(SUPPORT), str(REPOSITORY / "benchmarks")], runs=runs)]
    subprocess.run(program, check=True, env=environment, timeout=300, cwd=folder)
    return paths


def faulty(folder: Path, names: list[str]) -> Iterator[tuple[str, CauseReport]]:
    """Records and verifies faulty operators; asks about each."""
    gain = folder / "gain.txt"
    gain.write_text("1.5")
    uses = {n: f"use: 'zoo.{'loaded' if n == 'Loaded' else 'faulty'}:{n}'" for n in ["Leaves", *names]}
    uses["FromFile"] = f"use: 'zoo.faulty:FromFile', params: {{path: '{gain}'}}"
    paths = recorded(folder, {"before": uses["Leaves"], **uses})
    gain.write_text("2.5")
    yield from ((name, why(paths[name], verify(paths[name]), name)) for name in names)


def sound(folder: Path, names: list[str]) -> Iterator[tuple[str, CauseReport]]:
    """Records and verifies operators that repeat; asks about each as if it did not."""
    paths = recorded(folder, {n: f"use: 'zoo.{'faulty' if n == 'Sound' else 'operators'}:{n}'" for n in names})
    for name in names:
        report = verify(paths[name])
        for repeats in (False, True):
            found = why(paths[name], accused(report, name, repeats), name)
            yield f"{name}, {'repeats' if repeats else 'does not'}", found


def wild(folder: Path, names: list[str]) -> Iterator[tuple[str, CauseReport]]:
    """Records and verifies registrations; asks about each. The answer is not known beforehand."""
    paths = recorded(folder, {name: WILD[name] for name in names})
    yield from ((name, why(path, verify(path), name)) for name, path in paths.items())


def accused(report: VerifyReport, name: str, repeats: bool) -> VerifyReport:
    """The report of a verification in which an operator differs in its first call."""
    first = Difference(0, "fire", 0, "out", "", "")
    operators = tuple(replace(v, first=first, own_fault=True) if v.operator == name else v for v in report.operators)
    return replace(report, operators=operators, repeated={name: repeats}, comparisons={})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=[], help="operators by name")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--sound", action="store_true", help="ask about operators that repeat")
    which.add_argument("--wild", action="store_true", help="ask about registrations by other libraries")
    chosen = parser.parse_args()
    ask, able = (wild, list(WILD)) if chosen.wild else (faulty, [name for name in FAULTY if "," not in name])
    if chosen.sound:
        ask, able = sound, [*REPEATS, "Sound"]
    names = [name for name in able if not chosen.only or name in chosen.only]
    print("| operator | causes | line | re-runs | seconds |\n| --- | --- | --- | ---: | ---: |")
    wrong = total = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, found in ask(Path(folder), names):
            right = FAULTY.get(name, set())
            lines = [f"{Path(c.sites[0].file).name}:{c.sites[0].line}" for c in found.causes if c.sites]
            pointed = all(c.sites or c.kind in UNTRAPPED for c in found.causes)
            mistaken = not chosen.wild and (
                {c.kind for c in found.causes} != right or not pointed or bool(found.refused)
            )
            wrong, total = wrong + mistaken, total + 1
            said = found.refused or ", ".join(c.what for c in found.causes) or "–"
            cells = (f"{'! ' if mistaken else ''}{name}", said.replace(folder, "…"), ", ".join(lines), found.reruns)
            print("|", " | ".join(map(str, cells)), f"| {found.seconds:.1f} |", flush=True)
            if found.open or found.settled is False:
                print(f"{name}: settled {found.settled}, open {found.open}", file=sys.stderr)
    print(f"\n{total - wrong} of {total} answers are right")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
