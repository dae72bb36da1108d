"""The sources of a live run: each is read by a separate thread, at the pace of the clock; restarted by its policy.

A reader thread only reads, and appends to the inbox what it has read; everything else is done on the main thread. It
also ends the generator that it reads, so `close()` is never called while `stream()` runs.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from dataflow.chaos.faults import TO_SOURCES, SourceFaults
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.feeds.pace import Pace
from dataflow.execution.feeds.window import TransferCounters, Window
from dataflow.execution.restarts import Restarts
from dataflow.execution.source import SourceRunner, step_size, step_stamp
from dataflow.messages.base import Message
from dataflow.process.awake_clock import LOOK_EVERY, AwakeClock
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.log_pipe import SOURCE_THREAD, tell_outlived
from dataflow.process.streams.inbox import Inbox

MISSED_AFTER = 0.2
"""Seconds after which a step of a restarted source counts as missed."""
BACKLOG_EVERY = 0.5
EARLY = 10.0
"""Seconds for which a source waits for the clock that are worth a word."""
RETURN_WITHIN = 3.0
"""Seconds that `stream()` has to return when the process is closed."""

Step = Mapping[str, Message]
InItsPlace = Callable[[Callable[[Step], None], Step], bool]


class Reader:
    """Reads one source on a separate thread until the source ends, fails, or is to stop."""

    def __init__(self, owner: LiveSources, runner: SourceRunner, faults: SourceFaults, *, behind: bool) -> None:
        self.runner = runner
        self.unread = TransferCounters()
        self.failure: OperatorFailure | None = None
        """The failure of the thread, until it has been handled."""
        self.condemned: OperatorFailure | None = None
        """Why what it reads is of no use any more; it stops as soon as it can."""
        self.read_late = self.sent_late = 0.0
        """Seconds by which the last step was behind the clock: when it was read, and when it was sent."""
        self._last: int | None = None
        self._owner, self._faults, self._behind = owner, faults, behind
        self._lost = 0
        self._thread = threading.Thread(target=self._run, name=f"{SOURCE_THREAD}{runner.node.name}", daemon=True)
        self._thread.start()

    def join(self, clock: AwakeClock, deadline: float) -> bool:
        """Waits for the thread to end; False when it has not at the deadline, by that clock."""
        while self._thread.is_alive() and (left := deadline - clock()) > 0:
            self._thread.join(min(left, LOOK_EVERY))
        return not self._thread.is_alive()

    def _run(self) -> None:
        ended = False
        try:
            ended = self._read()
        except OperatorFailure as failure:
            self.failure = failure
        except BaseException as error:  # whatever it is, it ends this source, and under its name
            self.failure = OperatorFailure(self.runner.node.name, "the thread that reads stream()", error)
        if self.failure is None and not ended:
            self.failure = self.condemned
        if self.failure is not None:
            self._owner.inbox.put(("source_failed", self, self.failure))
        elif ended:
            self._owner.inbox.put(("source", self, None, self._lost))

    def _read(self) -> bool:
        """Reads until the source has ended (True) or is to stop."""
        owner, runner = self._owner, self.runner
        while not owner.stopping.is_set() and self.condemned is None:
            step = runner.take()
            if step is None:
                return True
            if not runner.source.real_time and not self._paced(step_stamp(step)):
                continue
            if self._faults.begun:
                for given in self._faults.apply(step, time.monotonic()):
                    self._hand_over(given)
            else:
                self._hand_over(step)
            runner.check_draws()
        runner.close_stream()
        return False

    def _paced(self, stamp: int) -> bool:
        """Holds a source that could wait to the clock, as a device would be; False for what a device would have seen
        while it was away. Ends early when the process stops."""
        pace = self._owner.pace
        if self._behind and pace.due_in(stamp) < -MISSED_AFTER:
            return False
        self._behind = False
        early = pace.due_in(stamp)
        self.read_late = max(0.0, -early)
        if early > EARLY:
            self._owner.tell_early(self.runner.node.name, self._last, stamp, early)
        self._last = stamp
        self._owner.stopping.wait(min(max(0.0, early), threading.TIMEOUT_MAX))
        return True

    def _hand_over(self, step: Step) -> None:
        """Emits a step, where the main thread has nothing else to do; else hands it over to that."""
        owner = self._owner
        if not self.unread.count and owner.in_its_place(self._emit, step):
            return
        if self.unread.count >= owner.backlog.messages or self.unread.size >= owner.backlog.nbytes:
            self._lost += 1
            owner.tell_backlog(self.unread.count, self.unread.size)
            return
        self.unread.put(*step_size(step))
        owner.inbox.put(("source", self, step, self._lost))
        self._lost = 0

    def _emit(self, step: Step) -> None:
        try:
            self._owner.emit(self, step, self._lost)
        except OperatorFailure as failure:
            self.condemned = failure
        except ChannelClosed:
            return  # the control thread sees to it
        self._lost = 0


class LiveSources:
    """The live sources of one process."""

    def __init__(
        self,
        inbox: Inbox,
        channel: Channel,
        pace: Pace,
        window: Window,
        backlog: Window,
        *,
        resumed: bool,
        in_its_place: InItsPlace = lambda act, step: False,
    ) -> None:
        """`in_its_place` lets another thread do something in the place of the main one; False if that cannot be."""
        self.in_its_place = in_its_place
        self.inbox, self.pace, self.backlog = inbox, pace, backlog
        self.stopping = threading.Event()
        self.runners: list[SourceRunner] = []
        self._channel, self._window, self._resumed = channel, window, resumed
        self._faults: dict[str, SourceFaults] = {}
        self._readers: dict[str, Reader] = {}
        self._restarts: dict[str, Restarts] = {}
        self._backlog_due = 0.0

    def add(self, runner: SourceRunner) -> None:
        name = runner.node.name
        self.runners.append(runner)
        self._faults[name] = SourceFaults()
        self._restarts[name] = Restarts(runner.node.live.restart, time.monotonic)

    def clock_measured(self, offset: int, delay: int) -> None:
        """Takes by how much this machine's clock is ahead (ns), at most half of `delay` wrong, for sources whose stamps
        are corrected by that."""
        for runner in self.runners:
            if runner.node.live.corrected and runner.source.real_time:
                runner.clock.measured(offset, delay)

    @property
    def ended(self) -> bool:
        return all(runner.ended for runner in self.runners)

    def first_stamps(self) -> list[int]:
        """The stamps that those sources begin with which need not be waited for."""
        able = [runner for runner in self.runners if not runner.source.real_time]
        return [stamp for runner in able if (stamp := runner.look_ahead()) is not None]

    def start(self) -> None:
        """Begins to read."""
        for runner in self.runners:
            self._read(runner, behind=self._resumed)

    def restarts_of(self, name: str) -> int:
        """Returns how often a source of this process was restarted here."""
        return self._restarts[name].total if name in self._restarts else 0

    def begin_fault(self, kind: str, operator: str, fields: Mapping[str, Any]) -> bool:
        """Does a planned fault, if it is one for a source that is here."""
        if operator not in self._faults or kind not in TO_SOURCES:
            return False
        self._faults[operator].begin(kind, fields, time.monotonic())
        return True

    # What readers hand over

    def take(self, reader: Reader, step: Step | None, lost: int) -> None:
        """Takes a step that was read (None: the source has ended), and how many were dropped before, as too many."""
        runner = reader.runner
        if step is not None:
            reader.unread.take(*step_size(step))
        if reader.condemned is not None and step is None:
            self.failed(reader, reader.condemned)
        if step is not None:
            try:
                self.emit(reader, step, lost)
            except OperatorFailure as failure:
                if runner.node.live.restart.max == 0 or self.stopping.is_set():
                    raise
                reader.condemned = failure  # it comes back as this source's failure when the thread has ended
        elif not runner.ended and reader.condemned is None:
            if lost:
                runner.refused["overflow"] += lost
            runner.finish()

    def emit(self, reader: Reader, step: Step, lost: int) -> None:
        """Emits a step that was read, if flow control lets it in. Raises `OperatorFailure`."""
        runner = reader.runner
        if runner.ended or reader.condemned is not None:
            return
        if lost:
            runner.refused["overflow"] += lost
        if self._window.full or self.backlog.full:
            runner.refused["overflow"] += 1
            if self.backlog.full:
                self.tell_backlog(self.backlog.count, self.backlog.size)
            return
        incarnation = runner.records.incarnation
        admitted = runner.emit_live(step)
        if admitted is None:
            return
        if runner.records.incarnation != incarnation:
            self._window.clear()
            self.backlog.clear()
            self._channel.send("jumped", operator=runner.node.name, stamp=runner.last)
        if not runner.source.real_time:
            reader.sent_late = max(0.0, -self.pace.due_in(runner.last))
        runner.promise()
        self._window.add(runner.last, *admitted)
        self.backlog.add(runner.last, *admitted)

    def tell_backlog(self, messages: int, nbytes: int) -> None:
        """Reports to the supervisor, now and then, that a source drops since so much waits; on any thread."""
        now = time.monotonic()
        if now >= self._backlog_due:
            self._backlog_due = now + BACKLOG_EVERY
            with contextlib.suppress(ChannelClosed):  # the control thread sees to it
                self._channel.send("backlog", messages=messages, bytes=nbytes)

    def tell_early(self, operator: str, last: int | None, stamp: int, seconds: float) -> None:
        """Reports to the supervisor that a source waits long for the clock, after a step at `last`; on any thread."""
        with contextlib.suppress(ChannelClosed):  # the control thread sees to it
            self._channel.send("early", operator=operator, last=last, stamp=stamp, seconds=seconds)

    def behind(self) -> dict[str, list[float]]:
        """For each source that could wait: seconds by which its last step was read and sent behind the clock."""
        readers = {name: reader for name, reader in self._readers.items() if not reader.runner.source.real_time}
        return {name: [reader.read_late, reader.sent_late] for name, reader in readers.items()}

    # Restarts

    def failed(self, reader: Reader, failure: OperatorFailure) -> None:
        """A source raised: it is restarted by its policy. Raises the failure when that allows it no more."""
        reader.failure = None
        if reader.runner.ended:
            raise failure
        self._outlive(reader.runner, failure)

    def next_due(self) -> float | None:
        """Seconds until a source is to be restarted; None when none is."""
        return min((r.due_in() for r in self._restarts.values() if r.pending), default=None)

    def restart_due(self) -> None:
        """Restarts the sources whose pause is over."""
        for runner in self.runners:
            restarts = self._restarts[runner.node.name]
            if restarts.pending and restarts.due_in() <= 0:
                restarts.begun()
                if not runner.ended:
                    self._restart(runner)

    def _outlive(self, runner: SourceRunner, failure: OperatorFailure) -> None:
        restarts = self._restarts[runner.node.name]
        if self.stopping.is_set() or not restarts.failed():
            raise failure
        tell_outlived(self._channel, failure, restarts.due_in())

    def _restart(self, runner: SourceRunner) -> None:
        try:
            runner.start_again()
        except OperatorFailure as failure:
            self._outlive(runner, failure)
        else:
            self._read(runner, behind=True)

    def _read(self, runner: SourceRunner, *, behind: bool) -> None:
        name = runner.node.name
        self._readers[name] = Reader(self, runner, self._faults[name], behind=behind)

    # End

    def finish(self, reason: str) -> None:
        """Ends the streams of all sources; their threads are to stop."""
        self._stop_reading()
        for runner in self.runners:
            runner.finish(reason)

    def _stop_reading(self) -> None:
        """Commands all threads to stop, and sources that wait for a device to let go of it; once."""
        if self.stopping.is_set():
            return
        self.stopping.set()
        for runner in self.runners:
            try:
                runner.source.stop_reading()
            except Exception as error:  # its thread may return all the same, and the run ends anyway
                print(f"{runner.node.name}: stop_reading(): {type(error).__name__}: {error}", file=sys.stderr)

    def await_readers(self) -> tuple[set[str], list[OperatorFailure]]:
        """Waits (bounded) for the threads; returns the sources whose thread did not return, and what went wrong in
        those that did."""
        self._stop_reading()
        clock = AwakeClock()
        deadline = clock() + RETURN_WITHIN
        late = {name for name, reader in self._readers.items() if not reader.join(clock, deadline)}
        for name in sorted(late):
            print(
                f"the stream() of source {name!r} did not return within {RETURN_WITHIN:g} s: close() is not called",
                file=sys.stderr,
            )
        failures = [r.failure for name, r in self._readers.items() if name not in late and r.failure is not None]
        return late, failures
