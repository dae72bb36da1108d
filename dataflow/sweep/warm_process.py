"""A warm process: it has loaded the commands and the operators' modules, and forks the runs of a sweep from itself.

Starting Python and importing all that a run needs costs more CPU time than a short run. The warm process has one
thread, reads no recording and holds no model, so each run is a process alone, as if it had been started by itself, and
memory does not grow with their number. It ends with the process that asks, and kills what a run left behind.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import socket
import sys
from collections.abc import Sequence
from functools import partial

import msgpack

from dataflow.parent import end_with_parent
from dataflow.process.polling import readable, received
from dataflow.process.start import become_warm, fork, threads
from dataflow.supervision.nursery_process import PRELOAD as OPERATORS
from dataflow.supervision.nursery_process import adopt_orphans, end_orphans

MOST_BYTES = 1 << 20
"""The longest request."""
COMMON = ("dataflow.cli.app", "dataflow.cli.start", "dataflow.cli.support.progress", "dataflow.graph.load")
COMMANDS = {
    "replay": (
        *COMMON,
        *OPERATORS,
        "dataflow.cli.commands.replay",
        "dataflow.cli.support.report",
        "dataflow.cli.support.viewers",
        "dataflow.interop.opening",
        "dataflow.reexecution.warm_start",
        "dataflow.shipped",
        "dataflow.supervision.early_nursery",
        "dataflow.supervision.run",
    ),
    "verify": (
        *COMMON,
        "dataflow.cli.commands.verification",
        "dataflow.cli.support.verdicts",
        "dataflow.verification.gate",
        "dataflow.verification.verify",
        "dataflow.verification.workers.job",
    ),
}
"""The modules that each command imports."""


def command(words: Sequence[str]) -> int:
    """Calls a command of this package; it ends in `SystemExit`."""
    sys.argv = ["dataflow", *words]
    importlib.import_module("dataflow.cli.start").main()
    return 0


def fetch(words: Sequence[str]) -> int:
    """Fetches a URL that fsspec opens into a file; returns the exit code."""
    import fsspec  # of the extra `remote`

    url, file = words
    store, path = fsspec.core.url_to_fs(url)
    store.get_file(path, file)
    return 0


CALLS = {"command": command, "fetch": fetch}


def make(call: str, words: Sequence[str], warm: int) -> int:
    """Makes a call in a fork of the process `warm`, with which it ends."""
    end_with_parent(parent=warm)
    return CALLS[call](words)


def serve(connection: socket.socket) -> None:
    """Makes one call after the other, each in a fork, until the connection is closed.

    A request holds the call, its words, and the operators to load before, as `module:name`; with it come the
    descriptors to which it prints. Answers: the id of its process with a handle of it, then its exit code. Where an
    operator cannot be shared by forks (what it imports has started a thread, or opened a file or device), the answer is
    its name, and this process ends.
    """
    loaded = set[str]()
    become_warm()
    while True:
        data, given = received(connection, MOST_BYTES, 2)
        if not data:
            return
        call, words, operators = msgpack.unpackb(data)
        for use in (use for use in operators if use not in loaded):
            if not _load(use):
                connection.send(msgpack.packb(["cold", use]))
                return
            loaded.add(use)
            become_warm()
        out, err = given
        pid = fork(partial(make, call, words, os.getpid()), (), os.environ, (out, err))
        for descriptor in given:
            os.close(descriptor)
        handle = os.pidfd_open(pid)
        try:
            socket.send_fds(connection, [msgpack.packb(["begun", pid])], [handle])
            gone = connection.fileno() in readable([handle, connection.fileno()], None)
        finally:
            os.close(handle)
        code = _buried(pid)
        if gone:
            return
        connection.send(msgpack.packb(["ended", code]))


def _load(use: str) -> bool:
    """Loads an operator, and returns whether forks can share it. An error is reported by the run that needs it."""
    before = _opened()
    module, _, name = use.partition(":")
    with contextlib.suppress(Exception, SystemExit):
        getattr(importlib.import_module(module), name)  # packages load the modules of operators when these are named
    return threads() == 1 and _opened() == before


def _opened() -> set[str]:
    """Returns what the descriptors of this process stand for."""
    found = set[str]()
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # that of the list itself
            found.add(f"{name} {os.readlink(f'/proc/self/fd/{name}')}")
    return found


def _buried(pid: int) -> int:
    """Returns the exit code of a run that is over, or is ended now, with everything that it started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGKILL)  # not waited for yet: no other process has its number
        os.killpg(pid, signal.SIGKILL)
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    end_orphans({pid}, pid)
    _, status = os.waitpid(pid, 0)
    return os.waitstatus_to_exitcode(status)


def main(descriptor: int, commands: Sequence[str]) -> None:
    """Serves the connection that a descriptor is."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    adopt_orphans()
    for name in dict.fromkeys(name for command in commands for name in COMMANDS[command]):
        importlib.import_module(name)
    with socket.socket(fileno=descriptor) as connection:
        serve(connection)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
