"""Calls functions in separate worker processes, side by side, and watches over them.

No network is involved: a worker has a socket pair to its parent and memory that both share. Whatever a worker does,
the wait for it is bounded, and it does not outlive the call.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from typing import Any

from dataflow.environments import Environment, environment_of
from dataflow.execution.threads import environment
from dataflow.process.channel import ChannelClosed
from dataflow.process.polling import readable
from dataflow.supervision.core.report import OperatorCounts, RunFailed, Status, Watch
from dataflow.supervision.interrupts import interrupts
from dataflow.verification.workers.board import Board
from dataflow.verification.workers.job_file import read_job_file, write_job_file
from dataflow.verification.workers.prestart import LEAVE_WITHIN, EarlyWorkers, PrestartedWorker, as_bytes

LOOK_EVERY = 0.1
SHOW_EVERY = 0.2
LAST_WORDS = 4000


@dataclass(frozen=True, slots=True)
class Call:
    """A call for a worker: the function as `module:name`, plain values for it, and the operators it will run.

    `environment`: variables of its process besides those of `execution.threads`; `env`: the environment of its
    operators (`dataflow.environments`), if any.
    """

    function: str
    request: Mapping[str, Any]
    operators: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    env: str | None = None


Locate = Callable[[Call, str, int], str]
"""(call of the worker, operator, calls that it has repeated) → the call that it is at, in words."""
Workers = Callable[..., list[Any]]
"""Answers calls as `call_workers` does, with its options."""


def call_workers(
    calls: Sequence[Call],
    *,
    threads: int,
    early: EarlyWorkers | None = None,
    stall_timeout: float = 120.0,
    locate: Locate = lambda call, operator, repeated: "a firing",
    watch: Watch | None = None,
) -> list[Any]:
    """Returns the answers to `calls`, each from a separate process.

    `threads`: of numerical libraries, as in a run. `early`: workers that were started before, to be taken first.
    `stall_timeout`: seconds allowed without a step of a worker. `watch` is given the status a few times a second.
    Raises `RunFailed` with the first that raises, dies or stalls; the others are then ended. Ctrl-C and SIGTERM end all
    of them, and raise a `RunFailed` that is `interrupted`.
    """
    status = Status(phase="starting", started=time.time())
    envs = {env: environment_of(env) for env in {call.env for call in calls} if env is not None}
    with ExitStack() as stack:
        interrupted = threading.Event()
        stack.enter_context(interrupts(interrupted.set))
        workers: list[_Worker] = []
        for number, call in enumerate(calls, start=1):
            started = None if early is None or call.env is not None else early.take(threads)
            worker = _Worker(number, call, started, threads, locate, envs.get(call.env or ""))
            workers.append(stack.enter_context(closing(worker)))
        shown = 0.0
        while left := [worker for worker in workers if not worker.answered]:
            for channel in readable([worker.channel for worker in left], LOOK_EVERY):
                next(worker for worker in left if worker.channel is channel).hear()
            if interrupted.is_set():
                raise RunFailed("interrupted", interrupted=True)
            for worker in left:
                worker.check(stall_timeout)
            if watch is not None and time.monotonic() - shown >= SHOW_EVERY:
                shown = time.monotonic()
                watch(_updated(status, workers))
        if watch is not None:
            watch(_updated(status, workers))
        return [worker.answer for worker in workers]


def _updated(status: Status, workers: Sequence[_Worker]) -> Status:
    seen: dict[str, OperatorCounts] = {}
    for worker in workers:
        if worker.board.steps:
            status.phase = "running"
        for name in worker.call.operators:
            told, _ = worker.board.counts(name)
            before = seen.get(name)
            if before is not None and name in worker.call.request.get("slices", ()):
                told = told.after(before)
            elif before is not None and told.firings <= before.firings:
                continue  # several repeat it: the one that is further is shown
            seen[name] = told
            status.process_of[name] = f"worker {worker.number}"
            status.operators[name] = told
    return status


class _Worker:
    """One worker process, as its parent sees it."""

    def __init__(
        self,
        number: int,
        call: Call,
        started: PrestartedWorker | None,
        threads: int,
        locate: Locate,
        env: Environment | None,
    ) -> None:
        """`started`: a process that waits already."""
        variables, python = {**environment(threads), **call.environment}, sys.executable
        if env is not None:
            variables, python = env.variables(variables), env.python
        if started is None:
            started = PrestartedWorker()
            started.spawn(variables, python)
        self.number, self.call, self._locate, self._started = number, call, locate, started
        self.answered, self.answer = False, None
        self._job_file, self.channel, self._output = started.job_file, started.channel, started.output
        self.board = Board(started.board, call.operators)
        write_job_file(
            self._job_file,
            {
                "function": call.function,
                "request": dict(call.request),
                "operators": list(call.operators),
                "environment": as_bytes(variables),
            },
        )
        with suppress(ChannelClosed):  # it has died: its end is read, with its words
            self.channel.send("go")
        self._steps, self._since = 0, time.monotonic()

    def hear(self) -> None:
        """Takes the answer. Raises `RunFailed` when there is none to come."""
        try:
            kind, _ = self.channel.receive()
        except ChannelClosed:
            raise self._failed(self._end()) from None
        if kind == "waiting":
            return
        answer = read_job_file(self._job_file)
        if kind == "failed":
            raise RunFailed(answer["summary"], answer["traceback"], answer["operator"])
        self.answered, self.answer = True, answer["value"]

    def _end(self) -> str:
        """The way in which the process ended, in words. It is not waited for yet: so its group keeps its number."""
        deadline = time.monotonic() + LEAVE_WITHIN
        while time.monotonic() < deadline:
            found = os.waitid(os.P_PID, self._started.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)
            if found is not None and found.si_code == os.CLD_EXITED:
                return f"ended its process with code {found.si_status}"
            if found is not None:
                return f"was killed by {signal.Signals(found.si_status).name}"
            time.sleep(0.01)
        return "closed its connection"

    def check(self, stall_timeout: float) -> None:
        """Raises `RunFailed` when the worker has made no step for so long."""
        now, steps = time.monotonic(), self.board.steps
        if steps != self._steps:
            self._steps, self._since = steps, now
        elif not self.answered and now - self._since > stall_timeout:
            raise self._failed(f"made no progress for {stall_timeout:g} s")

    def _failed(self, what: str) -> RunFailed:
        phase, operator = self.board.place()
        self._output.seek(0, os.SEEK_END)
        self._output.seek(max(0, self._output.tell() - LAST_WORDS))
        words = self._output.read().decode(errors="backslashreplace")
        if not operator:
            doing = "while starting" if phase == "start" else "while reading the recording"
            of = f" (operators {', '.join(self.call.operators)})" if self.call.operators else ""
            return RunFailed(f"worker {self.number}{of} {what} {doing}", words)
        at = f"{phase}()" if phase != "fire" else self._locate(self.call, operator, self.board.counts(operator)[1])
        return RunFailed(f"operator {operator!r} {what} in {at}", words, operator)

    def close(self) -> None:
        """Ends the process."""
        self.board.close()
        self._started.end()
