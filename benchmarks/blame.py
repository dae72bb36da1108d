"""Does `dataflow blame` find the chains of made graphs, of which is known what decides each value? Prints a table.

python benchmarks/blame.py [--seeds 0:20]

Graphs of three to five operators (selections, joins, declared and hidden state, batches; in
`tests/support/blamed_graphs.py`) are drawn by seed, recorded without the streams between the operators, and asked for
one value. Exit code 1 where a message that decided is missing, or one is named that cannot have decided.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY / "tests" / "support"))

import blamed_graphs  # noqa: E402

from dataflow.blame.chain import Blame  # noqa: E402
from dataflow.blame.field import Field  # noqa: E402
from dataflow.blame.links import Chain  # noqa: E402
from dataflow.recording import Recording  # noqa: E402


def found(case: blamed_graphs.Case, budget: float) -> Chain:
    with tempfile.TemporaryDirectory() as name:
        path = blamed_graphs.recorded(case, Path(name) / "run.mcap")
        with Recording(path) as recording:
            return Blame(recording, Field.parse(case.field), budget=budget).find()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:20", help="FIRST:END")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds for one")
    given = parser.parse_args()
    first, end = map(int, given.seeds.split(":"))
    right = 0
    print("| seed | operators | links | decided | missing | wrong | calls made | seconds |")
    print("| ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for seed in range(first, end):
        case = blamed_graphs.case(seed)
        chain = found(case, given.budget)
        sensed = {(link.message[0].rpartition("/")[2], link.message[2]) for link in chain.sensed if link.message}
        missing, wrong = case.truth.must - sensed, sensed - case.truth.must - case.truth.may
        right += not missing and not wrong
        numbers = f"{len(chain.links)} | {len(case.truth.must)} | {len(missing)} | {len(wrong)}"
        print(f"| {seed} | {' '.join(case.operators)} | {numbers} | {chain.made:,} | {chain.seconds:.1f} |", flush=True)
    print(f"\n{right} of {end - first} chains as they are known")
    return int(right < end - first)


if __name__ == "__main__":
    raise SystemExit(main())
