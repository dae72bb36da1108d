"""Starts a process of Python that runs a module: in a new interpreter, or as a fork where this process is *warm*.

A warm process has one thread and has loaded what its children need; it forks in milliseconds what a new interpreter
imports in half a second. Only a process that was made for it is warm (`dataflow.sweep.warm_process`).
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeAlias

from dataflow.execution.threads import THREADS, take_over
from dataflow.process.polling import readable

_HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_warm = False


def become_warm() -> None:
    """Lets this process fork what it starts. Modules loaded by now are never collected, so that pages stay shared."""
    global _warm
    _warm = True
    gc.collect()
    gc.freeze()


class ForkedProcess:
    """A child of this process, with those methods of `subprocess.Popen` that its starters use."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._handle = os.pidfd_open(pid)

    def poll(self) -> int | None:
        """Returns the exit code, negative for a signal; None while it runs."""
        if self.returncode is None and readable([self._handle], 0):
            _, status = os.waitpid(self.pid, 0)
            os.close(self._handle)
            self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Waits for its end and returns the exit code. Raises `subprocess.TimeoutExpired`."""
        if self.returncode is None and not readable([self._handle], timeout):
            raise subprocess.TimeoutExpired([f"process {self.pid}"], timeout or 0.0)
        code = self.poll()
        assert code is not None
        return code

    def kill(self) -> None:
        """Kills it, if it still runs."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


Process: TypeAlias = subprocess.Popen[bytes] | ForkedProcess


def start(
    module: str,
    words: Sequence[str],
    handed: Sequence[int],
    variables: Mapping[str, str],
    python: str = sys.executable,
    output: int | None = None,
) -> Process:
    """Starts `python -m module words...` as the leader of a process group; it inherits the descriptors `handed`.

    `variables`: its environment. `output`: where it prints; None: where this process does. In a fork, the module's
    `run(words)` is called, which returns the exit code. Raises `OSError`.
    """
    if _fits(variables, python):
        run = importlib.import_module(module).run
        return ForkedProcess(fork(lambda: run(words), handed, variables, None if output is None else (output, output)))
    return subprocess.Popen(
        [python, "-P", "-m", module, *words],
        pass_fds=handed,
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        process_group=0,
    )


def _fits(variables: Mapping[str, str], python: str) -> bool:
    """Returns whether a fork is what a new interpreter would be: libraries read these variables when they load, and
    locks that another thread holds would stay closed."""
    alike = all(variables.get(name) == os.environ.get(name) for name in (*THREADS, "PYTHONHASHSEED"))
    return _warm and alike and python == sys.executable and threads() == 1


def threads() -> int:
    """Returns the number of threads of this process, those of libraries included."""
    return len(os.listdir("/proc/self/task"))


def fork(
    call: Callable[[], int], handed: Iterable[int], variables: Mapping[str, str], output: tuple[int, int] | None
) -> int:
    """Forks a process that makes a call as if it were started with these descriptors and variables; returns its id.
    `output`: the descriptors to which its standard output and its errors go."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setpgid(0, 0)
        for number in _HANDLED:
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _take_streams(output, frozenset(handed))
        take_over({os.fsencode(name): os.fsencode(value) for name, value in variables.items()})
        code = call()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    return 0


def _take_streams(output: tuple[int, int] | None, handed: frozenset[int]) -> None:
    """Gives this process separate standard streams, and closes all else that it has inherited."""
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    if output is not None:
        os.dup2(output[0], 1)
        os.dup2(output[1], 2)
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        if descriptor > 2 and descriptor not in handed:
            with contextlib.suppress(OSError):  # that of the list itself
                os.close(descriptor)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
