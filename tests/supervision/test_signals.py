"""Which signals end a run."""

from __future__ import annotations

import functools
import signal
import subprocess
import sys

from dataflow.supervision.interrupts import ONE_REQUEST, interrupts

ASKS = """
import os, signal
from dataflow.supervision.interrupts import interrupts

stops = []
with interrupts(lambda: stops.append(1)):
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        before = len(stops)
        os.kill(os.getpid(), number)
        print(signal.Signals(number).name, len(stops) - before)
"""


def asked(*ignored: str) -> list[str]:
    """What each signal does to a run in a process that was begun with some signals ignored."""
    ignore = "; ".join(f"trap '' {name}" for name in ignored) or ":"
    command = ["sh", "-c", f'{ignore}; exec "$@"', "sh", sys.executable, "-c", ASKS]
    heard = functools.partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)  # this test may run under nohup itself
    found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30, preexec_fn=heard)
    return found.stdout.splitlines()


def test_a_run_is_asked_to_end_by_each_of_three_signals() -> None:
    assert asked() == ["SIGHUP 1", "SIGINT 1", "SIGTERM 1"]


def test_signals_that_were_ignored_at_the_start_stay_ignored() -> None:
    assert asked("HUP") == ["SIGHUP 0", "SIGINT 1", "SIGTERM 1"]  # as nohup does
    assert asked("INT", "HUP") == ["SIGHUP 0", "SIGINT 0", "SIGTERM 1"]  # as a script's background job is begun


def test_a_signal_that_is_sent_twice_at_once_asks_once() -> None:
    """`timeout` sends it to the process, and then to its group."""
    now, stops = [100.0], list[float]()
    with interrupts(lambda: stops.append(now[0]), lambda: now[0]):
        for after in (0.0, 0.02, 2 * ONE_REQUEST):
            now[0] += after
            signal.raise_signal(signal.SIGTERM)

    assert stops == [100.0, now[0]]
