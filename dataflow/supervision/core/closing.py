"""The end of a run: first the processes with operators leave, then the recorder and the like, then none is left.

A run that is stopped while it starts has nothing to drain: a process that is still starting is killed soon, which is
no failure. The sinks leave last: processes hand over firing records when they leave, and a sink is notified how the run
ended only when nothing can go wrong with the others any more. Every step is bounded; a process that is late is killed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dataflow.supervision.core.life import Life, Step
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import Phase, RunState, StackTraceRequests, notice
from dataflow.supervision.core.supervised import Supervised

LEAVE_TIMEOUT = 10.0
LEAVE_AT_ONCE = 1.0
DIE_WITHIN = 1.0
"""Seconds that one that was killed may take to die: what it left is for the recorder, before that is asked to leave."""
CLOSE_TIMEOUT = 60.0
"""Seconds for `close()` of every operator, at the orderly end of a run; a shorter `stall_timeout` shortens it."""
SHORTEST = 5.0


def bounded(stall_timeout: float) -> float:
    """Returns the seconds that a run which is to end may take for it."""
    return max(SHORTEST, min(CLOSE_TIMEOUT, stall_timeout))


class Closing:
    """Lets all processes leave. `failure` is why the run ends early: what fails later is a consequence and noted."""

    def __init__(
        self, run: RunState, *, outcome: str, failure: RunFailed | None, at_once: bool, hand_over: Callable[[], None]
    ) -> None:
        self.run, self.outcome, self.failure = run, outcome, failure
        self._at_once = at_once
        self._hand_over = hand_over
        self._asking = StackTraceRequests(run)
        self._deadline = 0.0
        run.enter(Phase.CLOSING)
        self._begin(sinks=False)

    @property
    def over(self) -> bool:
        """Returns whether no process is left; one that does not even die of a SIGKILL is not waited for."""
        left = [p for p in self.run.processes.values() if p.reachable]
        return all(p.life is Life.KILLED and self.run.steady - p.since > LEAVE_TIMEOUT for p in left)

    def fail(self, failure: RunFailed) -> None:
        """Something failed while the run is being closed."""
        if self.failure is None:
            self.failure = failure
        else:
            self.run.note(f"then: {failure}")

    def hurry(self) -> None:
        """The user does not want to wait."""
        self._at_once = True
        if self.failure is None:
            self.failure = RunFailed("stopped before everything was closed", interrupted=True)
        self._deadline = min(self._deadline, self.run.steady + self._time)

    def tick(self) -> None:
        """Goes on when a stage is through, or its time is up."""
        now = self.run.steady
        leaving = [p for p in self.run.processes.values() if p.is_sink == self._sinks and p.reachable]
        if self._has_run and self.failure is None and now > self._deadline - notice(self._time):
            self._asking.ask(leaving, self._deadline)
        if leaving and now > self._deadline:
            self._give_up_on(leaving)
        if not self._sinks and (not leaving or now > self._deadline + DIE_WITHIN):
            if self.failure is not None:
                self._hand_over()
            self._begin(sinks=True)

    @property
    def _has_run(self) -> bool:
        """Returns whether sources were released, so that there may be something to drain and to write."""
        return self.run.release is not None

    @property
    def _time(self) -> float:
        """Returns the seconds that those which leave now may take for it."""
        if not self._at_once and self.failure is None and self._has_run:
            return bounded(self.run.plan.stall_timeout)
        return (LEAVE_AT_ONCE if self._at_once else LEAVE_TIMEOUT) / (1 if self._sinks else 2)

    def _begin(self, *, sinks: bool) -> None:
        """Asks the sinks, or all others, to leave."""
        run, self._sinks = self.run, sinks
        outcome = self.outcome if self.failure is None else f"failed: {str(self.failure).splitlines()[0]}"
        for process in run.processes.values():
            if process.life is Life.AWAY:
                process.take(Step.GIVE_UP, run.steady)
            elif process.is_sink == sinks and process.take(Step.LEAVE, run.steady):
                more: dict[str, Any] = {"summaries": run.summaries()} if sinks else {}
                run.send(process, "leave", outcome=outcome, **more)
        self._deadline = run.steady + self._time

    def _give_up_on(self, late: list[Supervised]) -> None:
        names = "; ".join(p.describe() for p in late)
        if self.failure is None and not self._has_run and not self._sinks:
            self.run.note(f"still starting, and killed: {names}")
        elif self.failure is None:
            self.failure = RunFailed(f"did not close within {self._time:g} s: {names}", self.run.last_words(late))
        for process in late:
            self.run.kill(process, process.cause or "was killed since it did not leave")
