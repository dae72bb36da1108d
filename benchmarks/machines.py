"""Runs one graph on two machines, a robot's sensor and an operator here, over TLS through a bad link on this computer.

    python benchmarks/machines.py                # 20 ms each way; a stall of 10 s that ends in a reset
    python benchmarks/machines.py --size 230000 --steps 300 --period 0.033 --delay 0 --stall 0   # 0.92 MB at 30 Hz

The robot's agent is another process here, behind the relay of the tests (`tests/support/link_relay.py`). The
recording is verified on one machine.
"""

from __future__ import annotations

import argparse
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path += [str(REPOSITORY / "tests" / "support"), str(REPOSITORY / "tests" / "machines")]

from joined_agents import end, join  # noqa: E402
from link_relay import Relay  # noqa: E402

from dataflow.graph import load_text  # noqa: E402
from dataflow.machines.keys import issue, new_authority  # noqa: E402
from dataflow.supervision.plan import Rendezvous  # noqa: E402
from dataflow.supervision.run import run  # noqa: E402
from dataflow.verification.verify import verify  # noqa: E402

GRAPH = """\
graph: two_machines
namespace: test
operators:
  sensor: {{use: "machine_operators:Sensor",
    machine: robot, params: {{steps: {steps}, size: {size}, period: {period}}}}}
  here: {{use: "machine_operators:Scale", inputs: {{x: sensor/count}}, live: {{queue: block}}}}
"""
BEGUN = 50
"""Firings after which the link stalls."""


class Link:
    """The relay's state by what the run has done: stalls once, then resets."""

    def __init__(self, relay: Relay, stall: float) -> None:
        self.relay, self.stall = relay, stall
        self.freed = self.back = 0.0
        self._at_reset = 0

    def watch(self, status: object) -> None:
        """Looks at the run's progress."""
        here = getattr(status, "operators", {}).get("here")
        firings = 0 if here is None else here.firings
        if self.stall and firings > BEGUN:
            seconds, self.stall = self.stall, 0.0
            threading.Thread(target=self._stall, args=(seconds,), daemon=True).start()
        if self.freed and not self.back:
            self._at_reset = self._at_reset or firings
            if firings > self._at_reset:
                self.back = time.monotonic()

    def _stall(self, seconds: float) -> None:
        self.relay.stalled = True
        time.sleep(seconds)
        self.relay.reset()
        self.relay.stalled = False
        self.freed = time.monotonic()


def main() -> int:
    """Prints what arrived; returns 1 where something was lost uncounted, restarted, or does not verify."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--delay", type=float, default=0.02, help="seconds each way")
    parser.add_argument("--stall", type=float, default=10.0, help="seconds; 0: none")
    parser.add_argument("--size", type=int, default=2000, help="float32 numbers in a message")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--period", type=float, default=0.05, help="seconds between messages")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        new_authority(folder / "authority")
        issue(folder / "authority", folder / "laptop", "laptop", serves=["127.0.0.1"])
        issue(folder / "authority", folder / "robot", "robot")
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        relay = Relay(("127.0.0.1", port))
        relay.delay = given.delay
        agent = join("robot", f"tls/127.0.0.1:{relay.port}", folder / "files", "--keys", str(folder / "robot"))
        link = Link(relay, given.stall)
        graph = load_text(GRAPH.format(steps=given.steps, size=given.size, period=given.period))
        meeting, file = Rendezvous(f"tls/127.0.0.1:{port}", folder / "laptop"), folder / "run.mcap"
        try:
            report = run(graph, machines=meeting, live=True, record=file, watch=link.watch)
        finally:
            end(agent)
            relay.close()
        taken = report.summaries["here"]["taken"]
        dropped = sum(count for drops in report.drops.values() for _, _, count in drops)
        identical = verify(file).identical
    print(f"taken {taken} of {given.steps}, dropped and counted {dropped}, restarts {sum(report.restarts.values())}")
    if link.freed:
        print(f"back {link.back - link.freed:.2f} s after the reset")
    print(f"the recording on one machine: {'identical' if identical else 'different'}")
    return int(taken + dropped != given.steps or bool(report.restarts) or not identical)


if __name__ == "__main__":
    raise SystemExit(main())
