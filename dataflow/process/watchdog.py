"""The watchdog of a process: tells the supervisor a few times a second that the process lives, how much memory it
takes, and whether a firing takes longer than its operator's deadline. It runs on a thread of its own, since the main
one may hang.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import psutil

from dataflow.firing.protocol import Runner
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.complaints import Complaints

PERIOD = 0.05
BEAT_EVERY = 0.25


class Watchdog:
    """Watches the operators of this process until `stop`."""

    def __init__(self, channel: Channel, runners: Sequence[Runner], *, deadlines: bool) -> None:
        self._channel, self._runners, self._deadlines = channel, runners, deadlines
        self._process = psutil.Process()
        self._memory = 0
        self._told: set[str] = set()
        self._beat_due = 0.0
        self._complaints = Complaints()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the watching; waits (bounded) for the thread."""
        self._over.set()
        self._thread.join(timeout=1.0)

    def _work(self, now: float) -> tuple[str, int, float] | None:
        """The call that has taken more than a second, if any: operator, stamp, seconds."""
        for runner in self._runners:
            since = runner.working_since
            if since is not None and now - since > 1.0:
                return runner.node.name, runner.working_stamp, now - since
        return None

    def _run(self) -> None:
        while not self._over.wait(PERIOD):
            now = time.monotonic()
            try:
                self._look(now)
            except ChannelClosed:  # the supervisor is gone: the control thread sees to it
                return
            except Exception as error:  # a process that is not watched would be taken for dead
                self._complaints.say("watchdog", f"watchdog: {type(error).__name__}: {error}")

    def _look(self, now: float) -> None:
        for runner in self._runners:
            deadline, since = runner.node.live.deadline, runner.working_since
            if not self._deadlines or deadline is None or since is None or now - since <= deadline * 1e-9:
                self._told.discard(runner.node.name)
            elif runner.node.name not in self._told:
                self._told.add(runner.node.name)
                self._channel.send(
                    "overdue", operator=runner.node.name, stamp=runner.working_stamp, seconds=now - since
                )
        if now >= self._beat_due:
            self._beat_due = now + BEAT_EVERY
            self._channel.send("beat", memory=self._memory_taken(), work=self._work(now))

    def _memory_taken(self) -> int:
        """Resident memory in bytes; as it was last known where the system does not tell."""
        try:
            self._memory = self._process.memory_info().rss
        except (psutil.Error, OSError) as error:  # too many open files, say
            self._complaints.say("memory", f"watchdog: how much memory is taken is unknown: {error}")
        return self._memory
