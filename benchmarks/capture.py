"""Does `dataflow capture` make small tests of seeded bugs, that fail with them and pass without? Prints a table.

python benchmarks/capture.py

The ten bugs of `tests/support/zoo/bugs.py`, stateless and with a state, are recorded and captured; the recordings are
deleted; pytest runs the tests with the bugs and without. Exit code 1 where a test does not fail, does not pass, holds
more than 1 % of the calls (one at least) or 1 MB, or took more than 60 s (5 min with a state).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY / "tests" / "support"))

import seeded_bugs  # noqa: E402
from zoo import bugs  # noqa: E402


def main() -> int:
    rows, wrong = {}, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case in bugs.CASES:
            bug = case.use.__name__
            path = seeded_bugs.recorded(case, folder / f"{bug}.mcap")
            found, nbytes, seconds = seeded_bugs.captured(case, path, folder / f"test_{bug}.py")
            path.unlink()
            rows[f"test_{bug}"] = bug, found, nbytes, seconds
            most = 60 if case.use.stateless else 300
            if found.left > max(1, found.calls // 100) or nbytes > 1_000_000 or seconds > most:
                wrong.append(bug)
        tests = sorted(folder.glob("test_*.py"))
        with_bug, without = (seeded_bugs.outcomes(tests, fixed=fixed) for fixed in (False, True))
    print("| bug | wrong | calls | kept | begins with | bytes | seconds | with it | without |")
    print("| --- | --- | ---: | ---: | --- | ---: | ---: | --- | --- |")
    for test, (bug, found, nbytes, seconds) in rows.items():
        fails, passes = not with_bug[test], without[test]
        wrong += [] if fails and passes else [bug]
        told = f"{'fails' if fails else 'passes'} | {'passes' if passes else 'fails'}"
        size = f"{found.calls} | {found.left} | {found.begins} | {nbytes}"
        print(f"| {bug} | {found.wrong} | {size} | {seconds:.1f} | {told} |")
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main())
