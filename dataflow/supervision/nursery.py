"""The nursery: a process that has imported the runtime once and forks hosts from itself.

Starting Python and importing the runtime takes half a second a process; forking takes milliseconds. The nursery is
single-threaded, holds no session and no model, and runs with the environment that hosts need (thread counts, hash
seed). It ends when the supervisor does, and tells it how its children ended.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import msgpack

from dataflow.process.channel import Channel

START_WITHIN = 60.0
WORDS_PERIOD = 0.1
LEAVE_WITHIN = 15.0
PRELOAD = ("dataflow.process.host", "dataflow.process.sink", "dataflow.process.recorder", "dataflow.process.main")


class NurseryFailed(RuntimeError):
    """The nursery could not start or died; the message holds its last words."""


class Child:
    """A forked host process, as the supervisor sees it."""

    def __init__(self, nursery: Nursery, pid: int, channel: Channel, words: int) -> None:
        self.nursery, self.pid, self.channel, self._words = nursery, pid, channel, words

    def lines(self, over: threading.Event) -> Iterator[str]:
        """What it prints, line by line, until it has closed its output or, soon after `over` is set, falls silent.

        A process that the child has left behind may hold its output open, so the end of it is not waited for.
        """
        rest = b""
        try:
            while True:
                readable, _, _ = select.select([self._words], [], [], WORDS_PERIOD)
                data = os.read(self._words, 65536) if readable else b""
                *whole, rest = (rest + data).split(b"\n")
                for line in whole:
                    yield line.decode(errors="backslashreplace").rstrip()
                if (readable and not data) or (not readable and over.is_set()):
                    break
            if rest:
                yield rest.decode(errors="backslashreplace").rstrip()
        finally:
            os.close(self._words)

    def poll(self) -> int | None:
        """The exit code (negative: the signal that killed it), None while it runs."""
        return self.nursery.exit_code(self.pid, timeout=0.0)

    def wait(self, timeout: float) -> int | None:
        """The exit code, None when it still runs after `timeout` seconds."""
        return self.nursery.exit_code(self.pid, timeout=timeout)

    def kill(self) -> None:
        self.signal(signal.SIGKILL)

    def signal(self, number: signal.Signals) -> None:
        """Sends a signal, if it still runs."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it ended just now
                os.kill(self.pid, number)


class Nursery:
    """The supervisor's end. One thread at a time."""

    def __init__(self, environment: dict[str, str]) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "dataflow.supervision.nursery", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
                env=environment,
                stdin=subprocess.DEVNULL,
                process_group=0,
            )
        self._socket = ours
        self._unread = b""
        self._codes: dict[int, int] = {}
        self._spawned: list[int] = []

    def spawn(self) -> Child:
        """Forks a host, which waits for its configuration on its channel. Raises `NurseryFailed`."""
        channel, descriptor = Channel.pair()
        reading, writing = os.pipe()
        try:
            socket.send_fds(self._socket, [b"s"], [descriptor, writing])
            deadline = time.monotonic() + START_WITHIN
            while not self._spawned:
                if not self._read(deadline - time.monotonic()):
                    raise NurseryFailed("the process that starts the hosts did not answer")
        except (OSError, NurseryFailed) as error:
            channel.close()
            os.close(reading)
            code = self._process.poll()
            raise NurseryFailed(f"cannot start a host process: {error} (exit code {code})") from error
        finally:
            os.close(descriptor)
            os.close(writing)
        return Child(self, self._spawned.pop(), channel, reading)

    def exit_code(self, pid: int, timeout: float) -> int | None:
        """How a child ended; waits up to `timeout` seconds. None: it runs, or nobody is left who knows."""
        deadline = time.monotonic() + timeout
        while pid not in self._codes:
            if not self._read(max(0.0, deadline - time.monotonic())):
                if not _runs(pid) and not self._alive():
                    return -signal.SIGKILL
                if time.monotonic() >= deadline:
                    return None
        return self._codes[pid]

    def close(self) -> None:
        """Ends the nursery, and with it any child that is left."""
        self._socket.close()
        try:
            self._process.wait(timeout=LEAVE_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(timeout=LEAVE_WITHIN)

    def _alive(self) -> bool:
        return self._process.poll() is None

    def _read(self, timeout: float) -> bool:
        """Takes in what the nursery says; False when nothing came in time or it is gone."""
        readable, _, _ = select.select([self._socket], [], [], max(0.0, timeout))
        if not readable:
            return False
        data = self._socket.recv(65536)
        if not data:
            return False
        unpacker = msgpack.Unpacker()
        unpacker.feed(self._unread + data)
        read = 0
        for what, pid, code in unpacker:
            read = unpacker.tell()
            if what == "spawned":
                self._spawned.append(pid)
            else:
                self._codes[pid] = code
        self._unread = (self._unread + data)[read:]
        return True


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _fork_host(descriptor: int, words: int, inherited: list[int]) -> int:
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setpgid(0, 0)
        os.dup2(words, 1)
        os.dup2(words, 2)
        for other in (words, *inherited):
            os.close(other)
        sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
        from dataflow.process.main import main

        code = main(descriptor)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)  # libraries' threads must not be able to hold up the end


def serve(connection: socket.socket) -> None:
    """Forks on request and reports ends, until the supervisor closes the connection."""
    children: dict[int, int] = {}  # pidfd → pid
    while True:
        readable, _, _ = select.select([connection.fileno(), *children], [], [])
        for pidfd in readable:
            if pidfd == connection.fileno():
                continue
            pid = children.pop(pidfd)
            os.close(pidfd)
            _end_group(pid)
            _, status = os.waitpid(pid, 0)
            _tell(connection, "ended", pid, os.waitstatus_to_exitcode(status))
        if connection.fileno() in readable:
            request, descriptors, _, _ = socket.recv_fds(connection, 1, 2)
            if not request:
                break
            descriptor, words = descriptors
            pid = _fork_host(descriptor, words, [connection.fileno(), *children])
            os.close(descriptor)
            os.close(words)
            children[os.pidfd_open(pid)] = pid
            _tell(connection, "spawned", pid, 0)
    _outlive(children)


def _end_group(pid: int) -> None:
    """Ends a host and what its operators have started. To be called before the host is waited for: until then nobody
    else can have its group's number."""
    with contextlib.suppress(
        ProcessLookupError, PermissionError
    ):  # it has not become a group of its own yet, or no more
        os.killpg(pid, signal.SIGKILL)


def _tell(connection: socket.socket, what: str, pid: int, code: int) -> None:
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the supervisor is gone; serve() sees that next
        connection.sendall(msgpack.packb([what, pid, code]))


def _outlive(children: dict[int, int]) -> None:
    """The supervisor is gone: its hosts notice by themselves and leave; those that do not are killed."""
    deadline = time.monotonic() + LEAVE_WITHIN - 3.0
    while children and (left := deadline - time.monotonic()) > 0:
        readable, _, _ = select.select(list(children), [], [], left)
        for pidfd in readable:
            pid = children.pop(pidfd)
            _end_group(pid)
            os.waitpid(pid, 0)
    for pid in children.values():
        _end_group(pid)
        os.waitpid(pid, 0)


def main(descriptor: int) -> None:
    """The nursery process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import importlib

    for name in PRELOAD:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()
    with socket.socket(fileno=descriptor) as connection:
        serve(connection)


if __name__ == "__main__":
    main(int(sys.argv[1]))
