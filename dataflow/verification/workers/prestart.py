"""Worker processes that wait for their calls: started by the caller, or before the calls are known.

Next to nothing is imported here, so that a command can start them before it imports what it needs itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from typing import IO

from dataflow.execution.threads import THREADS, environment
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.polling import readable
from dataflow.process.start import Process, start

LEAVE_WITHIN = 10.0
MOST_EARLY = 2
"""Workers that are started early, at most: more start when it is known that there is work for them."""
_PR_SET_CHILD_SUBREAPER = 36


class PrestartedWorker:
    """A worker: what it shares with its parent, and, once that is known, its number. It waits for `go`."""

    def __init__(self) -> None:
        self.pid = 0
        self._process: Process | None = None
        self.job_file, self.board = os.memfd_create("call"), os.memfd_create("board")
        self.output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self.channel, self.theirs = Channel.pair()

    def handed(self) -> tuple[int, int, int, int]:
        """Returns the descriptors that the worker inherits."""
        return self.theirs, self.job_file, self.board, self.output.fileno()

    def spawn(self, variables: Mapping[str, str], python: str = sys.executable) -> None:
        """Starts its process with an environment."""
        self._process = _spawn([self], variables, python)
        self.pid = self._process.pid

    def hear(self) -> bool:
        """Waits until it reports its process id; returns False when it has ended before."""
        try:
            _, fields = self.channel.receive()
        except ChannelClosed:
            return False
        self.pid = fields["pid"]
        return True

    def end(self) -> None:
        """Ends the process, if it still runs, with everything that its operators have started."""
        if self.pid:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)  # not waited for yet: no other has its number
            if self._process is not None:
                self._process.wait(timeout=LEAVE_WITHIN)
            else:
                _await_end(self.pid)
        for descriptor in (self.job_file, self.board):
            os.close(descriptor)
        self.channel.close()
        self.output.close()


def _await_end(pid: int) -> None:
    """Waits (bounded) for a process that has become a child of this one."""
    handle = os.pidfd_open(pid)
    try:
        if readable([handle], LEAVE_WITHIN):
            os.waitpid(pid, 0)
    finally:
        os.close(handle)


def _spawn(workers: list[PrestartedWorker], variables: Mapping[str, str], python: str = sys.executable) -> Process:
    """Starts the process of one worker; or one that forks itself for each, and ends: they are this process's then."""
    handed = [worker.handed() for worker in workers]
    slots = [",".join(map(str, each)) for each in handed]
    try:
        descriptors = [descriptor for each in handed for descriptor in each]
        words = workers[0].output.fileno()
        return start("dataflow.verification.workers.worker", slots, descriptors, variables, python, words)
    finally:
        for worker in workers:
            os.close(worker.theirs)  # the worker has its own; with ours open its death would go unseen


def _adopts(yes: bool) -> bool:
    """Makes this process the parent of descendants whose own parent ends, or no longer; False where it cannot be."""
    return bool(ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(yes), 0, 0, 0) == 0)


class EarlyWorkers:
    """Starts workers that have no call yet: one process imports what they need, and is the worker, or becomes all."""

    def __init__(self, count: int) -> None:
        self._environment = environment(1)
        self._waiting: list[PrestartedWorker] = []
        self._maker: Process | None = None
        if not _adopts(True):
            return
        with contextlib.suppress(OSError):  # a caller that needs one tries again, and reports the error
            self._waiting = [PrestartedWorker() for _ in range(count)]
            if count == 1:
                self._waiting[0].spawn(self._environment)
            else:
                self._maker = _spawn(self._waiting, self._environment)

    def foresee(self, modules: Iterable[str]) -> None:
        """Has them import modules that they will need, found as they are found here."""
        fields = {"modules": sorted(modules), "environment": as_bytes(environment(1))}
        for worker in self._waiting:
            with contextlib.suppress(ChannelClosed):  # it has died: `take` finds that
                worker.channel.send("import", **fields)

    def take(self, threads: int) -> PrestartedWorker | None:
        """Returns one for libraries with so many threads; None where there is none."""
        wanted = environment(threads)
        if not self._waiting or any(self._environment[name] != wanted[name] for name in THREADS):
            return None
        worker = self._waiting.pop(0)
        if not worker.hear():  # the caller that starts another one gets the error
            worker.end()
            return None
        return worker

    def close(self) -> None:
        """Ends those that have not been taken."""
        if self._maker is not None:
            self._maker.kill()
            self._maker.wait(timeout=LEAVE_WITHIN)
        while self._waiting:
            worker = self._waiting.pop()
            if not worker.pid:
                worker.hear()
            worker.end()
        _adopts(False)


def as_bytes(environment: Mapping[str, str]) -> dict[bytes, bytes]:
    """Returns an environment for a message to a worker."""
    return {os.fsencode(name): os.fsencode(value) for name, value in environment.items()}


@contextlib.contextmanager
def early_workers(jobs: int | None) -> Iterator[EarlyWorkers]:
    """Starts workers for a verification by `jobs` of them, or by as many as there are cores."""
    early = EarlyWorkers(min(jobs or len(os.sched_getaffinity(0)), MOST_EARLY))
    try:
        yield early
    finally:
        early.close()
