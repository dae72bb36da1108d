"""Calls in warm processes: a fork each, for what asks for them (`dataflow.sweep.warm_process`)."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any, Literal

import msgpack

from dataflow.execution.threads import environment
from dataflow.process.polling import readable, received

STEP = 0.2
"""Seconds between two looks at whether to stop."""
LEAVE_WITHIN = 10.0
"""Seconds that a warm process gets to end, with what it has forked."""
KILLED = -int(signal.SIGKILL)
STANDARD_ERROR = 2
"""Takes the prints of modules that are imported for all runs: standard output is for results."""


class Worker:
    """Makes one call after the other, in processes that a warm one forks. That is started by `start` or with the first
    call, and again where it was killed."""

    def __init__(self, commands: Sequence[str]) -> None:
        """`commands`: those that it will call."""
        self._commands = tuple(commands)
        self._cold = set[str]()
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._called = False

    def start(self) -> None:
        """Begins the warm process, which loads the commands while this one does something else."""
        self._connected()

    def call(
        self,
        kind: Literal["command", "fetch"],
        words: Sequence[str],
        operators: Sequence[str],
        output: tuple[Path, Path],
        timeout: float,
        stop: Event | None = None,
    ) -> int | None:
        """Makes a call, with `operators` (`module:name`) loaded before; returns its exit code, negative for a signal,
        None after `timeout` seconds or where it was stopped. Its output goes to the two files. Nothing that it
        started outlives this call.
        """
        deadline, self._called = time.monotonic() + timeout, True
        with output[0].open("wb") as out, output[1].open("wb") as err:
            while True:
                loaded = [use for use in operators if use not in self._cold]
                connection = self._connected()
                try:
                    socket.send_fds(connection, [msgpack.packb([kind, words, loaded])], [out.fileno(), err.fileno()])
                    answer, handles = self._heard(connection, deadline, stop)
                except OSError:  # it was killed
                    answer, handles = None, []
                if answer is None or answer[0] != "cold":
                    break
                self._cold.add(answer[1])
                self.close()
        if answer is None:
            self.close()
            return None if _over(deadline, stop) else KILLED
        return self._ended(connection, handles[0], deadline, stop)

    def _ended(self, connection: socket.socket, handle: int, deadline: float, stop: Event | None) -> int | None:
        """Awaits the end of a process that has begun, or brings it about."""
        try:
            answer, _ = self._heard(connection, deadline, stop)
            if answer is not None:
                return int(answer[1])
            over = _over(deadline, stop)
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
            if not over or self._heard(connection, time.monotonic() + LEAVE_WITHIN, None)[0] is None:
                self.close()
            return None if over else KILLED
        finally:
            os.close(handle)

    def _connected(self) -> socket.socket:
        if self._socket is None:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                words = [str(theirs.fileno()), *self._commands]
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "dataflow.sweep.warm_process", *words],
                    pass_fds=(theirs.fileno(),),
                    env={**environment(1), "PYTHONUNBUFFERED": "1"},
                    stdin=subprocess.DEVNULL,
                    stdout=STANDARD_ERROR,
                    process_group=0,
                )
            self._socket = ours
        return self._socket

    @staticmethod
    def _heard(connection: socket.socket, deadline: float, stop: Event | None) -> tuple[list[Any] | None, list[int]]:
        """Returns an answer with its descriptors; None where the process is gone, or it is time to stop."""
        while not _over(deadline, stop):
            if readable([connection], min(STEP, max(0.0, deadline - time.monotonic()))):
                data, handles = received(connection, 1 << 16, 1)
                return (msgpack.unpackb(data) if data else None), handles
        return None, []

    def close(self) -> None:
        """Ends the warm process, and a call that it is at; at once where it was never called."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            if not self._called:
                self._process.kill()
            try:
                self._process.wait(timeout=LEAVE_WITHIN)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None


def _over(deadline: float, stop: Event | None) -> bool:
    return time.monotonic() >= deadline or (stop is not None and stop.is_set())
