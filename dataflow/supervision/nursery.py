"""The supervisor's end of the nursery: requests processes and gets their exit codes. Nothing here waits but `close`."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack

from dataflow.environments import Environment, environment_of
from dataflow.process.channel import QueuedChannel
from dataflow.process.polling import readable
from dataflow.process.start import start
from dataflow.supervision.core.life import how_it_ended
from dataflow.supervision.nursery_process import DIE_WITHIN, ENVIRONMENT, MORE, MOST_DESCRIPTORS, SPAWN, adopt_orphans

LEAVE_WITHIN = 15.0
LIBRARIES = ("cv2", "scipy.fft", "scipy.ndimage", "scipy.optimize", "scipy.sparse.csgraph", "scipy.spatial")
"""Those that operators need most, and that start no threads when they load."""
WORDS_AT_ONCE = 65536
_PR_GET_CHILD_SUBREAPER = 37


@contextlib.contextmanager
def adopting() -> Iterator[None]:
    """Makes this process the parent of those that a nursery leaves, if it dies: so their ends are known."""
    libc = ctypes.CDLL(None, use_errno=True)
    before = ctypes.c_int(0)
    libc.prctl(_PR_GET_CHILD_SUBREAPER, ctypes.byref(before), 0, 0, 0)
    adopt_orphans()
    try:
        yield
    finally:
        adopt_orphans(bool(before.value))


class NurseryFailed(RuntimeError):
    """The nursery could not start or died."""


class Child:
    """One process: its control channel, what it prints, and a handle that no other process can take over."""

    def __init__(self, channel: QueuedChannel, words: int) -> None:
        self.channel = channel
        self.pid: int | None = None
        """None until the nursery has forked it."""
        self._words: int | None = words
        self._rest = b""
        self._pidfd: int | None = None
        self._due: list[int] = []
        os.set_blocking(words, False)

    @property
    def words(self) -> int | None:
        """The descriptor to read what it prints from; None when that is over."""
        return self._words

    def born(self, pid: int, pidfd: int) -> None:
        self.pid, self._pidfd = pid, pidfd
        for number in self._due:
            self.signal(number)

    def lines(self) -> list[str]:
        """Returns the lines that it has printed since the last look."""
        found: list[bytes] = []
        while self._words is not None:
            try:
                data = os.read(self._words, WORDS_AT_ONCE)
            except BlockingIOError:
                break
            *whole, self._rest = (self._rest + data).split(b"\n")
            found += whole
            if not data:
                found += self._close_words()
            if len(data) < WORDS_AT_ONCE:
                break
        return [line.decode(errors="backslashreplace").rstrip() for line in found]

    def _close_words(self) -> list[bytes]:
        """Ends the reading; what it has left behind may hold its output open, so that is not waited for."""
        if self._words is not None:
            os.close(self._words)
            self._words = None
        rest, self._rest = self._rest, b""
        return [rest] if rest else []

    def signal(self, number: int) -> None:
        """Sends a signal, if it still runs."""
        if self._pidfd is None:
            self._due.append(number)
            return
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, number)

    @property
    def dead(self) -> bool:
        """Returns whether it has ended, for when no process is left to report that."""
        return self._pidfd is not None and bool(readable([self._pidfd], 0))

    def bury(self) -> int | None:
        """Returns the exit code of one that has ended when no nursery is left to; kills what is left of its group.

        None: it is not ours, since this process adopts no orphans.
        """
        if self._pidfd is None or self.pid is None:
            return None
        try:
            os.waitid(os.P_PIDFD, self._pidfd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            with contextlib.suppress(ProcessLookupError, PermissionError):  # nothing is left of it
                os.killpg(self.pid, signal.SIGKILL)  # it is not waited for yet: no other process has its number
            found = os.waitid(os.P_PIDFD, self._pidfd, os.WEXITED | os.WNOHANG)
        except ChildProcessError:
            return None
        if found is None:
            return None
        return found.si_status if found.si_code == os.CLD_EXITED else -found.si_status

    def await_end(self, within: float) -> None:
        """Waits (bounded) until it has ended; one that the nursery has not named, until its output ends."""
        if self._pidfd is not None:
            readable([self._pidfd], within)
            self.bury()
            return
        self.channel.close()  # it leaves, if it is there at all
        deadline = time.monotonic() + within
        while self._words is not None and (left := deadline - time.monotonic()) > 0:
            readable([self._words], left)
            self.lines()

    def close(self) -> list[str]:
        """Closes everything that belongs to it; returns its last line, if it had no end."""
        rest = self._close_words()
        self.channel.close()
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None
        return [line.decode(errors="backslashreplace").rstrip() for line in rest]


@dataclass(frozen=True, slots=True)
class ChildExited:
    """A child has ended with this exit code, negative for a signal."""

    child: Child
    code: int


@dataclass(frozen=True, slots=True)
class Orphans:
    """A child has left these processes behind, or one of several that ended at once; they were killed."""

    children: tuple[Child, ...]
    processes: tuple[str, ...]


def nurseries_of(envs: Mapping[str, str | None], common: Mapping[str, str]) -> dict[str, Nursery]:
    """Starts a nursery for each environment of processes; returns those of processes that are in one, by label.

    `envs`: by label of a process what `env:` names; `common`: the variables of processes that are in none. Raises
    `EnvError`.
    """
    found = {env: environment_of(env) for env in envs.values() if env is not None}
    started = {env: Nursery(common, of) for env, of in found.items()}
    return {label: started[env] for label, env in envs.items() if env is not None}


class Nursery:
    """Starts processes. The first one takes half a second, while the nursery imports the runtime."""

    def __init__(self, environment: Mapping[str, str], env: Environment | None = None) -> None:
        """`environment`: the variables of its processes; `env`: the environment that they are in, if any."""
        self.environment = environment if env is None else env.variables(environment)
        self._called = "the process that starts the others" + ("" if env is None else f" in {env.folder}")
        python = sys.executable if env is None else env.python
        ours, theirs = socket.socketpair()
        with theirs:
            words, handed = (str(theirs.fileno()),), (theirs.fileno(),)
            self._process = start("dataflow.supervision.nursery_process", words, handed, self.environment, python)
        ours.setblocking(False)
        self._socket = ours
        self._unpacker = msgpack.Unpacker()
        self._unborn: deque[Child] = deque()
        self._pidfds: deque[int] = deque()
        self._children: dict[int, Child] = {}

    def fileno(self) -> int:
        return self._socket.fileno()

    def give(self, environment: Mapping[str, str]) -> None:
        """Gives the processes to come another environment, and the libraries that are loaded here already, whose
        loading takes a third of a second. What those of the runtime read when they load has been read before.

        Raises `NurseryFailed`.
        """
        self.environment = environment
        given = {os.fsencode(name): os.fsencode(value) for name, value in environment.items()}
        try:
            with os.fdopen(os.memfd_create("environment"), "wb") as file:
                file.write(msgpack.packb([given, [name for name in LIBRARIES if name in sys.modules]]))
                file.flush()
                socket.send_fds(self._socket, [ENVIRONMENT], [file.fileno()])
        except OSError as error:
            raise NurseryFailed(f"cannot reach the process that starts the others: {error}") from error

    def spawn(self, handed: Sequence[int] = ()) -> Child:
        """Asks for a process, which waits for its configuration on its channel and inherits the descriptors `handed`.

        Raises `NurseryFailed`.
        """
        channel = QueuedChannel()
        reading, writing = os.pipe()
        try:
            given = [channel.theirs, writing, *handed]
            while len(given) > MOST_DESCRIPTORS:
                socket.send_fds(self._socket, [MORE], given[:MOST_DESCRIPTORS])
                given = given[MOST_DESCRIPTORS:]
            socket.send_fds(self._socket, [SPAWN], given)
        except OSError as error:
            channel.close()
            os.close(reading)
            raise NurseryFailed(f"cannot start a process: {error}") from error
        finally:
            os.close(channel.theirs)
            os.close(writing)
        child = Child(channel, reading)
        self._unborn.append(child)
        return child

    def receive(self) -> list[ChildExited | Orphans]:
        """Takes in the nursery's messages. Raises `NurseryFailed` when it is gone."""
        try:
            data, pidfds, _, _ = socket.recv_fds(self._socket, 65536, 16)
        except BlockingIOError:
            return []
        except OSError as error:
            raise NurseryFailed(f"{self._called} is gone: {error}") from error
        self._pidfds.extend(pidfds)
        if not data:
            with contextlib.suppress(subprocess.TimeoutExpired):  # its end of the socket closes before it is dead
                self._process.wait(timeout=DIE_WITHIN)
            raise NurseryFailed(f"{self._called} {how_it_ended(self._process.poll())}")
        self._unpacker.feed(data)
        news = (self._taken(*message) for message in self._unpacker)
        return [each for each in news if each is not None]

    def _taken(self, what: str, pid: int, fact: Any) -> ChildExited | Orphans | None:
        match what:
            case "spawned":
                child = self._unborn.popleft()
                child.born(pid, self._pidfds.popleft())
                self._children[pid] = child
                return None
            case "left":
                processes, others = fact
                return Orphans(tuple(self._children[each] for each in (pid, *others)), tuple(processes))
            case _:
                return ChildExited(self._children.pop(pid), int(fact))

    def close(self) -> None:
        """Ends the nursery, and with it any process that is left."""
        if not self._children and not self._unborn:
            self._process.kill()  # it may be importing still
        self._socket.close()
        for child in self._unborn:  # no signal reaches them yet: they leave by themselves
            child.channel.close()
        try:
            self._process.wait(timeout=LEAVE_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(timeout=LEAVE_WITHIN)
        for child in (*self._children.values(), *self._unborn):  # it was killed before it could end them
            child.await_end(LEAVE_WITHIN)
