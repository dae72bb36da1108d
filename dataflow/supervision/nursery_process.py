"""The nursery: a process that has imported the runtime once and forks the others of a run from itself.

Starting Python and importing the runtime takes half a second a process; forking takes milliseconds. The nursery is
single-threaded, holds no session and no model, and runs with the environment that operators need (thread counts, hash
seed). It ends when the supervisor does, and reports to it how its children ended.

Processes that operators start must end with their process, also if they have left its process group or session: each
operators' process is a subreaper (prctl(2)), which inherits such a descendant when its parent ends, as the nursery does
in turn.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import os
import signal
import socket
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgpack
import psutil

from dataflow.execution.threads import take_over
from dataflow.process.polling import readable, received

LEAVE_WITHIN = 12.0
"""Seconds that its children get after the supervisor is gone."""
DIE_WITHIN = 1.0
MOST_DESCRIPTORS = 253
"""As many as one message on a Unix socket carries."""
MORE, SPAWN, ENVIRONMENT = b"+", b"s", b"e"
"""A request: descriptors, of which more follow; the last ones for a process that is to be started; a file with the
environment of the processes to come and the libraries to load for them."""
PRELOAD = (
    "dataflow.process.operator_process",
    "dataflow.process.log_pipe",
    "dataflow.sinks.sink",
    "dataflow.sinks.recorder",
    "dataflow.supervision.process_main",
)

_PR_SET_CHILD_SUBREAPER = 36


def adopt_orphans(wanted: bool = True) -> None:
    """Makes this process the parent of descendants whose parent ends, or no longer."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_CHILD_SUBREAPER, int(wanted), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")


def _fork_process(descriptor: int, words: int, handed: Sequence[int], inherited: Iterable[int]) -> int:
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setpgid(0, 0)
        adopt_orphans()
        os.dup2(words, 1)
        os.dup2(words, 2)
        for other in (words, *inherited):
            os.close(other)
        from dataflow.process import stacks
        from dataflow.process.log_pipe import install
        from dataflow.supervision.process_main import main

        stacks.answer()
        install()
        code = main(descriptor, handed)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)  # libraries' threads must not be able to hold up the end


def serve(connection: socket.socket) -> None:
    """Forks on request and reports ends, until the supervisor closes the connection."""
    children: dict[int, int] = {}  # pidfd → pid
    descriptors: list[int] = []
    while True:
        ready = readable([connection.fileno(), *children], None)
        for pidfd in ready:
            if pidfd != connection.fileno():
                _ended(connection, children, pidfd)
        if connection.fileno() in ready:
            request, given = received(connection, 1, MOST_DESCRIPTORS)
            if not request:
                break
            descriptors += given
            if request == MORE:
                continue
            if request == ENVIRONMENT:
                _take_environment(descriptors.pop())
                continue
            descriptor, words, *handed = descriptors
            pid = _fork_process(descriptor, words, handed, [connection.fileno(), *children])
            for each in descriptors:
                os.close(each)
            descriptors = []
            pidfd = os.pidfd_open(pid)
            children[pidfd] = pid
            _tell(connection, "spawned", pid, None, [pidfd])
    _outlive(children)


def _take_environment(descriptor: int) -> None:
    """Takes over the environment in a file, as if this process had been started with it: PYTHONPATH, too. Then loads
    libraries once for all processes to come; one that cannot be loaded is left to the operator that needs it."""
    with open(descriptor, "rb") as file:
        file.seek(0)
        environment, libraries = msgpack.unpackb(file.read(), raw=True)
    take_over(environment)
    for name in libraries:
        with contextlib.suppress(ImportError):
            importlib.import_module(name.decode())
    gc.collect()
    gc.freeze()


def _ended(connection: socket.socket | None, children: dict[int, int], pidfd: int) -> None:
    """Buries a process and everything that its operators have started."""
    pid = children.pop(pidfd)
    os.close(pidfd)
    with contextlib.suppress(ProcessLookupError, PermissionError):  # it does not lead a group yet
        os.killpg(pid, signal.SIGKILL)  # before it is waited for: until then no other process can have its number
    left = end_orphans({pid, *children.values()}, pid)
    _, status = os.waitpid(pid, 0)
    if connection is not None:
        if left:
            others = [children[each] for each in readable(list(children), 0.0)]  # have ended, too: it may be theirs
            _tell(connection, "left", pid, [left, others])
        _tell(connection, "ended", pid, os.waitstatus_to_exitcode(status))


def end_orphans(known: set[int], group: int) -> list[str]:
    """Kills every child that is not `known`, and theirs; returns those that had left the process group."""
    left = []
    while orphans := [pid for pid in _children() if pid not in known]:
        for pid in orphans:
            name = _name_outside(pid, group)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)  # our own child, not waited for yet: no other has its number
            if not _await_death(pid):
                known.add(pid)
            if name:
                left.append(f"{name} (process {pid})")
    return left


def _children() -> list[int]:
    listed = Path(f"/proc/self/task/{os.getpid()}/children")
    if listed.exists():
        return [int(word) for word in listed.read_text().split()]
    return [child.pid for child in psutil.Process().children()]


def _name_outside(pid: int, group: int) -> str:
    """Returns the name of a process that runs outside a group, else nothing."""
    try:
        process = psutil.Process(pid)
        runs = process.status() != psutil.STATUS_ZOMBIE
        return str(process.name()) if runs and os.getpgid(pid) != group else ""
    except (psutil.Error, ProcessLookupError):
        return ""


def _await_death(pid: int) -> bool:
    """Waits (bounded) for a child that was killed."""
    pidfd = os.pidfd_open(pid)
    try:
        dead = bool(readable([pidfd], DIE_WITHIN))
    finally:
        os.close(pidfd)
    if dead:
        os.waitpid(pid, 0)
    return dead


def _tell(connection: socket.socket, what: str, pid: int, fact: Any, descriptors: Iterable[int] = ()) -> None:
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the supervisor is gone; serve() sees that next
        data = msgpack.packb([what, pid, fact])
        sent = socket.send_fds(connection, [data], list(descriptors))
        connection.sendall(data[sent:])


def _outlive(children: dict[int, int]) -> None:
    """The supervisor is gone: the children notice by themselves and leave; those that do not are killed."""
    deadline = time.monotonic() + LEAVE_WITHIN
    while children and (left := deadline - time.monotonic()) > 0:
        for pidfd in readable(list(children), left):
            _ended(None, children, pidfd)
    for pidfd, pid in list(children.items()):
        signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        if readable([pidfd], DIE_WITHIN):
            _ended(None, children, pidfd)
        else:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(pid, signal.SIGKILL)


def run(words: Sequence[str]) -> int:
    """Runs the nursery process on the descriptor that a word names; returns its exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from dataflow.process import stacks

    stacks.ignore()
    adopt_orphans()
    for name in PRELOAD:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()
    with socket.socket(fileno=int(words[0])) as connection:
        serve(connection)
    return 0


if __name__ == "__main__":
    run(sys.argv[1:])
