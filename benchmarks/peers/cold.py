"""Costs of a message with cold caches: the round trip of `roundtrip.yaml` in one Python process, by stage.

    python benchmarks/peers/cold.py                      # this checkout
    python benchmarks/peers/cold.py --against OTHER      # another checkout in turns with this one, in one run

Both processes of the round trip are here as what they are, with their links, aligners, black boxes and firing records,
but without a network; each waits where it would wait for its eventfd, and is woken in turn. Before each turn all sleep,
and a buffer larger than the CPU's caches is read, so that a turn finds what a process finds that has waited for 10 ms.
No wake-up of a process is in these figures. They are medians over turns, and the turns of two checkouts alternate; so a
machine that is busy with other things disturbs both alike.

Needs greenlet (`pip install -e '.[dev]'`).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
STAGES = {
    "emit": "source: made, checked, digested, recorded, encoded, into the ring",
    "emit, after": "source: until it waits again",
    "relay in": "relay: out of the ring, decoded, aligned, called",
    "relay out": "relay: made, checked, digested, recorded, encoded, into the ring",
    "relay, after": "relay: until it waits again",
    "sink": "sink: out of the ring, decoded, aligned, called",
    "sink, after": "sink: until it waits again",
}
ROUND_TRIP = ("emit", "relay in", "relay out", "sink")


class Stopped(Exception):
    """There are no more turns."""


class Pair:
    """The two processes of a round trip, each a greenlet."""

    def __init__(self, size: int) -> None:
        import greenlet
        import roundtrip_operators

        from dataflow.process import live_sources

        self.hub = greenlet.getcurrent()
        self.greenlet = greenlet.greenlet
        self.marks: dict[str, int] = {}
        self.reader: Any = None
        operators = roundtrip_operators
        clock = SimpleNamespace(
            sleep=lambda seconds: self.hub.switch(), monotonic_ns=self._marked("begun"), time_ns=time.time_ns
        )
        vars(operators)["time"] = clock
        for cls, method, name in ((operators.Echo, "process", "relayed"), (operators.Pong, "process", "taken")):
            setattr(cls, method, self._after_mark(name, getattr(cls, method)))
        vars(os)["eventfd_write"] = self._after_mark("woken", os.eventfd_write)
        vars(live_sources)["threading"] = SimpleNamespace(
            Thread=self._reader, Event=threading.Event, TIMEOUT_MAX=threading.TIMEOUT_MAX
        )
        self.near, self.far = self._processes(size)

    def _marked(self, name: str) -> Callable[[], int]:
        def mark() -> int:
            now = self.marks[name] = time.monotonic_ns()
            return now

        return mark

    def _after_mark(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def marked(*arguments: Any, **fields: Any) -> Any:
            self.marks[name] = time.monotonic_ns()
            return function(*arguments, **fields)

        return marked

    def _reader(self, target: Callable[[], None], **_: Any) -> Any:
        self.reader = self.greenlet(target)
        return SimpleNamespace(start=lambda: None, join=lambda timeout: None, is_alive=lambda: False)

    def _processes(self, size: int) -> tuple[Any, Any]:
        from dataflow.graph import load_graph
        from dataflow.process.config import ProcessConfig
        from dataflow.process.descriptors import take_descriptors
        from dataflow.process.operator_process import OperatorProcess
        from dataflow.process.streams.inbox import Inbox
        from dataflow.process.streams.outlet import Network
        from dataflow.records.black_box import make_black_box
        from dataflow.supervision.configs import configurations
        from dataflow.supervision.links import Links, pairs_of
        from dataflow.supervision.plan import RunPlan, process_plans

        settings = [f"nbytes={size}", "count=1000000"]
        graph = load_graph(str(HERE / "roundtrip.yaml"), settings=settings, live=True)
        plan = RunPlan(graph, live=True)
        plans = process_plans(plan)
        configs = configurations(plan, plans, dict.fromkeys(plans, ""))
        self.links = Links(list(plans), pairs_of(graph, plans))
        made = []
        for label, (_, config) in configs.items():
            handed = take_descriptors([*self.links.handed(label), make_black_box()], config)
            inbox = Inbox(handed.wake, handed.incoming)
            channel: Any = SimpleNamespace(send=lambda kind, **fields: None)
            one = OperatorProcess(ProcessConfig(**config), channel, inbox, handed.outgoing, box=handed.box)
            publishers: Any = {stream: SimpleNamespace(matched=False) for stream in graph.streams}
            nowhere: Any = SimpleNamespace(active=False)
            one.outlet.open(Network(nowhere, nowhere, nowhere, publishers))
            inbox._poll = SimpleNamespace(poll=lambda timeout: self._sleep())  # type: ignore[assignment]
            one.make()
            one.set_up()
            made.append(one)
        for one in made:
            one.orders.released = True
            one.outlet.release()
            one.pace.begin(None, time.time())
            one.driver.ready.wake_all()
            one.live.start()
        near, far = made
        with contextlib.suppress(ImportError):  # a checkout in which messages are made elsewhere and copied
            from dataflow.messages.fields.memory import make_large_arrays_in

            make_large_arrays_in(near.outlet.room)  # as its process would; the answers of the other one are small
        self.loops = {"near": self.greenlet(near.run), "far": self.greenlet(far.run)}
        for loop in self.loops.values():
            loop.switch()  # until it waits
        self.reader.switch()
        return near, far

    def _sleep(self) -> list[Any]:
        """Stands for a wait: returns what a poll returns when it was woken."""
        self.hub.switch()
        return [1]

    def turn(self, chill: Callable[[], None]) -> dict[str, float]:
        """One round trip; returns µs by stage."""
        marks = self.marks
        chill()
        self.reader.switch()
        emitted = time.monotonic_ns()
        begun, sent = marks["begun"], marks["woken"]
        chill()
        relayed_from = time.monotonic_ns()
        self.loops["far"].switch()
        relayed = time.monotonic_ns()
        answered = marks["woken"]
        chill()
        taken_from = time.monotonic_ns()
        self.loops["near"].switch()
        taken = time.monotonic_ns()
        for window in (self.near.window, self.near.backlog):  # no supervisor here reports progress to the source
            window.clear()
        spans = {
            "emit": sent - begun,
            "emit, after": emitted - sent,
            "relay in": marks["relayed"] - relayed_from,
            "relay out": answered - marks["relayed"],
            "relay, after": relayed - answered,
            "sink": marks["taken"] - taken_from,
            "sink, after": taken - marks["taken"],
        }
        return {name: nanoseconds / 1e3 for name, nanoseconds in spans.items()}


def worker(size: int, megabytes: int) -> None:
    """Makes a turn for each line it reads, a cold one or ("warm") not; prints its figures as JSON."""
    import numpy as np

    walked = np.zeros(megabytes << 20, np.uint8)

    def chill() -> None:
        time.sleep(0.01)
        walked[::64].sum()

    pair = Pair(size)
    for line in sys.stdin:
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        took = pair.turn(chill if line.strip() == "cold" else lambda: None)
        took["faults"] = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
        print(json.dumps(took), flush=True)
    os._exit(0)


class Worker:
    """A worker process of one checkout."""

    def __init__(self, tree: Path, size: int, megabytes: int) -> None:
        environment = os.environ | {"PYTHONPATH": f"{tree}:{HERE}", "PYTHONHASHSEED": "0"}
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), "--worker", str(size), "--walk", str(megabytes)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=tree,
        )

    def turn(self, kind: str) -> dict[str, float]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(kind + "\n")
        self._process.stdin.flush()
        found: dict[str, float] = json.loads(self._process.stdout.readline())
        return found

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def measure(trees: list[Path], size: int, turns: int, kind: str, megabytes: int) -> list[dict[str, float]]:
    """Returns the medians of each checkout, by stage."""
    workers = [Worker(tree, size, megabytes) for tree in trees]
    found: list[list[dict[str, float]]] = [[] for _ in trees]
    for _ in range(turns):
        for each, one in zip(found, workers, strict=True):
            each.append(one.turn(kind))
    for one in workers:
        one.close()
    for each in found:
        del each[: min(20, turns // 2)]
        for took in each:
            took["round trip"] = sum(took[name] for name in ROUND_TRIP)
    return [{name: statistics.median(took[name] for took in each) for name in each[0]} for each in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--turns", type=int, default=150)
    parser.add_argument("--sizes", default="1008,921600")
    parser.add_argument("--walk", type=int, default=32, help="MB read before each turn")
    parser.add_argument("--warm", action="store_true", help="neither sleep nor read")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker is not None:
        worker(arguments.worker, arguments.walk)
        return
    trees = [ROOT] if arguments.against is None else [ROOT, arguments.against.resolve()]
    kind = "warm" if arguments.warm else "cold"
    for size in (int(each) for each in arguments.sizes.split(",")):
        here, *others = measure(trees, size, arguments.turns, kind, arguments.walk)
        print(f"\n{size:,} bytes, {kind}, median of {arguments.turns} turns, µs\n")
        print("| stage | here |" + " there | here / there |" * len(others))
        print("| --- | --- |" + " --- | --- |" * len(others))
        for name in ("round trip", *STAGES, "faults"):
            there = [f" {other[name]:,.0f} | {here[name] / max(other[name], 1e-3):.2f} |" for other in others]
            print(f"| {name} | {here[name]:,.0f} |" + "".join(there))


if __name__ == "__main__":
    main()
