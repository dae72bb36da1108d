"""The watchdog of a process: reports to the supervisor a few times a second that the process lives, how much memory it
takes, and whether a firing takes longer than its operator's deadline. It runs on a separate thread, since the main one
may hang.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import psutil

from dataflow.execution.protocol import Runner
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.throttled_warnings import ThrottledWarnings

PERIOD = 0.05
BEAT_EVERY = 0.25
STOPPED_AFTER = 0.2
"""Seconds without a look after which a process that has hardly computed was stopped meanwhile."""
COMPUTED = 0.5
"""The share of them for which one that was not stopped has computed: a call that keeps Python's lock, say."""


class Watchdog:
    """Watches the operators of this process until `stop`."""

    def __init__(self, channel: Channel, runners: Sequence[Runner], *, deadlines: bool) -> None:
        self._channel, self._runners, self._deadlines = channel, runners, deadlines
        self._process = psutil.Process()
        self._memory = 0
        self._told: set[str] = set()
        self._beat_due = 0.0
        self._looked, self._cpu = time.monotonic(), time.process_time()
        self._calls: dict[str, tuple[float, float]] = {}
        """Operator → when its call began (monotonic), and for how long it has been at it while this process ran."""
        self._complaints = ThrottledWarnings()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the watching; waits (bounded) for the thread."""
        self._over.set()
        self._thread.join(timeout=1.0)

    def _run(self) -> None:
        while not self._over.wait(PERIOD):
            try:
                self._look()
            except ChannelClosed:  # the supervisor is gone: the control thread sees to it
                return
            except Exception as error:  # a process that is not watched would be taken for dead
                self._complaints.say("watchdog", f"watchdog: {type(error).__name__}: {error}")

    def _look(self) -> None:
        now, work = time.monotonic(), None
        passed = self._passed(now)
        for runner in self._runners:
            name, deadline = runner.node.name, runner.node.live.deadline
            seconds = self._at_call(runner, now, passed)
            if seconds > 1.0 and work is None:
                work = name, runner.working_stamp, seconds
            if not self._deadlines or deadline is None or seconds <= deadline * 1e-9:
                self._told.discard(name)
            elif name not in self._told:
                self._told.add(name)
                self._channel.send("overdue", operator=name, stamp=runner.working_stamp, seconds=seconds)
        if now >= self._beat_due:
            self._beat_due = now + BEAT_EVERY
            self._channel.send("beat", memory=self._memory_taken(), work=work)

    def _passed(self, now: float) -> float:
        """Returns the seconds since the last look, as far as this process ran meanwhile."""
        cpu, passed = time.process_time(), now - self._looked
        if passed > STOPPED_AFTER and cpu - self._cpu < COMPUTED * passed:
            passed = PERIOD
        self._looked, self._cpu = now, cpu
        return passed

    def _at_call(self, runner: Runner, now: float, passed: float) -> float:
        """Returns for how long an operator has been at its call (s); 0 where it is at none."""
        name, since = runner.node.name, runner.working_since
        if since is None:
            self._calls.pop(name, None)
            return 0.0
        begun, seconds = self._calls.get(name, (since, 0.0))
        seconds = seconds + passed if begun == since and name in self._calls else min(now - since, passed)
        self._calls[name] = since, seconds
        return seconds

    def _memory_taken(self) -> int:
        """Resident memory in bytes; as it was last known where the system does not report it."""
        try:
            self._memory = self._process.memory_info().rss
        except (psutil.Error, OSError) as error:  # too many open files, say
            self._complaints.say("memory", f"watchdog: how much memory is taken is unknown: {error}")
        return self._memory
