"""One operator through all replays: called in this process, or in one of its environment.

Both sides have the same messages and numpy 1.26 or newer, so values go as pickles of protocol 4, which these versions
read of each other.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.connection import Connection, Pipe
from typing import Any

from dataflow.environments import environment_of, is_environment
from dataflow.execution.calls import Calls
from dataflow.execution.effects.journal import RecordedJournal
from dataflow.execution.failure import OperatorFailure, readable
from dataflow.execution.restarts import close_quietly
from dataflow.execution.threads import environment, limit_threads
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import Operator
from dataflow.parent import end_with_parent
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sync import Firing

PROTOCOL = 4
LONGEST = 1800.0
"""Seconds that a call may take in another process."""
LEAVE_WITHIN = 5.0
"""Seconds after which that process is killed."""


class OperatorRaised(RuntimeError):
    """Raised for what an operator raised in its own process: by the name of that error, with its text."""

    @classmethod
    def as_read(cls, words: str) -> OperatorRaised:
        """The error that `readable` put into words, which gives the same words of this one."""
        name, _, text = words.partition(": ")
        kind: type[OperatorRaised] = type(name, (cls,), {})
        return kind(text) if text else kind()


class InProcessOperator:
    """An operator whose calls are made in this process. `shell`: itself."""

    def __init__(self, node: Node, seed: int, version: int) -> None:
        self._node, self._journal = node, RecordedJournal()
        self._calls = Calls(node, node.make(), seed, version=version, effects=self._journal)
        self.setup, self.parameter = self._calls.setup, self._calls.parameter
        self.snapshot, self.restore, self.summary = self._calls.snapshot, self._calls.restore, self._calls.summary

    @property
    def shell(self) -> Operator:
        """Returns the operator object."""
        return self._calls.operator

    def anew(self) -> None:
        """Begins with a new operator."""
        close_quietly(self._calls.operator)
        self._calls.operator = self._node.make()
        self._calls.setup()

    def process(self, firing: Firing, detail: Mapping[str, Any]) -> Mapping[str, Message]:
        """Makes a firing; its effects get the answers in `detail`, of its record. Raises what the operator raises."""
        self._journal.begin(detail)
        return self._calls.process(firing)

    def close(self) -> None:
        """Closes the operator."""
        close_quietly(self._calls.operator)


class ChildProcessOperator:
    """An operator whose calls are made by a process in its environment. `shell`: another object of its class, which is
    not set up.

    Its methods do what those of `InProcessOperator` do; what a firing raises is `OperatorRaised`. Raises `EnvError`,
    and `ReplayError` where the process ends or hangs.
    """

    def __init__(self, node: Node, seed: int, version: int, threads: int) -> None:
        assert node.env is not None
        place, self._node = environment_of(node.env), node
        self.shell: Operator = node.operator(**node.params)
        self._pipe, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(
                [place.python, "-P", "-m", __name__, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                env=place.variables(environment(threads)),
                stdin=subprocess.DEVNULL,
                stdout=2,  # results go to standard output
            )
        try:
            self._ask("make", node, seed, version, threads)
        except BaseException:
            self.close()
            raise

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._ask, name)

    def close(self) -> None:
        """Ends the process."""
        self._pipe.close()
        try:
            self._process.wait(LEAVE_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(LEAVE_WITHIN)

    def _ask(self, name: str, *arguments: Any) -> Any:
        try:
            self._pipe.send_bytes(pickle.dumps((name, arguments), PROTOCOL))
            if not self._pipe.poll(LONGEST):
                raise ReplayError(f"{self._node.name}: {name}() is not over after {LONGEST:g} s in its environment")
            what, found = pickle.loads(self._pipe.recv_bytes())
        except (EOFError, OSError) as error:
            self.close()
            code = self._process.returncode
            raise ReplayError(f"{self._node.name}: its process in {self._node.env} ended ({code})") from error
        if what == "failed":
            raise OperatorFailure(self._node.name, found[0], OperatorRaised.as_read(found[1]))
        if what == "raised":
            raise OperatorRaised.as_read(found)
        return found


def serve(pipe: Connection) -> None:
    """Makes the calls of one operator, as they are asked for, until the other side closes."""
    here: InProcessOperator | None = None
    while True:
        try:
            name, arguments = pickle.loads(pipe.recv_bytes())
        except EOFError:
            break
        try:
            if here is None:
                *made_of, threads = arguments
                here, found = InProcessOperator(*made_of), None
                limit_threads(threads)
            else:
                found = getattr(here, name)(*arguments)
            answer = "given", found
        except OperatorFailure as error:
            answer = "failed", (error.when, error.summary)
        except BaseException as error:  # whatever an operator raises is reported, as in a run
            answer = "raised", readable(error)
        pipe.send_bytes(pickle.dumps(answer, PROTOCOL))
    if here is not None:
        here.close()


def operator_of(node: Node, seed: int, version: int, threads: int) -> InProcessOperator | ChildProcessOperator:
    """Returns an operator that is called in its environment: in this process where that is here. Raises `EnvError`."""
    elsewhere = node.env is not None and not is_environment(node.env)
    return ChildProcessOperator(node, seed, version, threads) if elsewhere else InProcessOperator(node, seed, version)


if __name__ == "__main__":
    end_with_parent()
    serve(Connection(int(sys.argv[1])))
