"""Round trips between two processes, ours and the peers' in turns in one run: ratios with their spread.

    python benchmarks/peers/roundtrip.py --peers VENV
    python benchmarks/peers/roundtrip.py --peers VENV --rounds 9 --sizes 1008,921600,8294400 --only ours,dora
    python benchmarks/peers/roundtrip.py --against OTHER_CHECKOUT --only ours,there

VENV is a virtual environment with dora-rs, dora-rs-cli, eclipse-zenoh, iceoryx2, lcm, pyarrow and numpy.

One process sends an array that holds the time, another answers with its first eight bytes, 100 times a second or after
the `--pause` that is asked for; a round trip ends when the first process has the answer as a number. Every contestant's
processes are started anew for each round and size, so one bad placement cannot decide. The figure of a round is its
median; the table gives the median over rounds and, of the ratio to dora, the smallest and largest over rounds: on a
noisy machine ratios of one round mean more than times of different ones.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
WARM_UP = 20


class Failed(RuntimeError):
    """A contestant that gave no result, with the cause."""


def script(name: str, peers: Path | None) -> Callable[[int, int], list[float]]:
    """A contestant that is one Python script: `name.py BYTES COUNT` prints a JSON list of microseconds."""

    def run(size: int, count: int) -> list[float]:
        python = sys.executable if peers is None else str(peers / "bin" / "python")
        return parsed(finished([python, str(HERE / f"{name}.py"), str(size), str(count)]))

    return run


def dora(peers: Path) -> Callable[[int, int], list[float]]:
    def run(size: int, count: int) -> list[float]:
        path = f"{peers / 'bin'}{os.pathsep}{os.environ['PATH']}"
        output = finished(
            [str(peers / "bin" / "dora"), "run", str(HERE / "dora.yaml")],
            PATH=path,
            VIRTUAL_ENV=str(peers),  # or dora starts its nodes by the `.venv` of this checkout, if there is one
            BYTES=str(size),
            COUNT=str(count),
        )
        return parsed(output.split("TOOK ", 1)[-1].splitlines()[0])

    return run


def ours(tree: Path, record: Path | None = None) -> Callable[[int, int], list[float]]:
    """A live run of `roundtrip.yaml` with the code of a checkout, in a separate interpreter; recorded, if asked."""

    def run(size: int, count: int) -> list[float]:
        command = [sys.executable, "-P", "-m", "dataflow.cli.main", "run", str(HERE / "roundtrip.yaml"), "--live"]
        command += ["--quiet", "--json", "--set", f"nbytes={size}", "--set", f"count={count}"]
        command += [] if record is None else ["--record", str(record), "--overwrite"]
        report = finished(command, PYTHONPATH=os.pathsep.join([str(tree), str(HERE)]))
        return parsed(json.loads(report)["summaries"]["pong"]["took"])

    return run


def finished(command: list[str], **environment: str) -> str:
    """The standard output of a command, run where no checkout is the current folder. Raises `Failed`."""
    env = {**os.environ, **environment}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=env, cwd=HERE)
    except (subprocess.TimeoutExpired, OSError) as error:
        raise Failed(str(error)) from error
    if done.returncode:
        raise Failed((done.stderr.strip() or done.stdout.strip()).splitlines()[-1])
    return done.stdout


def parsed(text: str) -> list[float]:
    try:
        return [float(x) for x in json.loads(text)]
    except ValueError as error:
        raise Failed(f"no result in {text[-200:]!r}") from error


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, help="the environment of the peers; else ours and the floor only")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--sizes", default="1008,921600,8294400")
    parser.add_argument("--pause", type=float, default=0.01, help="seconds from one answer to the next message")
    parser.add_argument("--against", type=Path, help="another checkout, as contestant `there`")
    parser.add_argument("--only", default="", help="names of contestants, separated by commas")
    arguments = parser.parse_args()
    os.environ["PAUSE"] = str(arguments.pause)
    contestants: dict[str, Callable[[int, int], list[float]]] = {"ours": ours(ROOT), "floor": script("floor", None)}
    if arguments.against is not None:
        contestants["there"] = ours(arguments.against.resolve())
    if arguments.peers is not None:
        contestants["dora"] = dora(arguments.peers)
        for name in ("zenoh", "iceoryx", "lcm"):
            contestants[name] = script(f"{name}_pair", arguments.peers)
    if arguments.only:
        contestants = {name: contestants[name] for name in arguments.only.split(",")}
    sizes = [int(size) for size in arguments.sizes.split(",")]
    medians: dict[tuple[str, int], dict[int, float]] = {}
    for round_ in range(arguments.rounds):
        for size in sizes:
            for name, run in contestants.items():
                try:
                    took = run(size, arguments.count)[WARM_UP:]
                    medians.setdefault((name, size), {})[round_] = statistics.median(took)
                except Failed as failure:
                    print(f"{name}, {size} bytes, round {round_}: {failure}", file=sys.stderr)
    print(f"\nround trip, median of {arguments.rounds} rounds of {arguments.count - WARM_UP}, µs\n")
    print("| bytes | contestant | µs | x dora (smallest - largest) |\n| --- | --- | --- | --- |")
    for size in sizes:
        reference = medians.get(("dora", size), {})
        for name in contestants:
            rounds = medians.get((name, size), {})
            if not rounds:
                print(f"| {size:,} | {name} | no result | |")
                continue
            ratios = [value / reference[k] for k, value in rounds.items() if k in reference]
            text = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} - {max(ratios):.2f})" if ratios else ""
            print(f"| {size:,} | {name} | {statistics.median(rounds.values()):,.0f} | {text} |")


if __name__ == "__main__":
    main()
