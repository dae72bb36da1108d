"""Asking the processes of a running graph: how far their operators are, and what their parameters are."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack

from dataflow.client.attach import network_of
from dataflow.messages import Message
from dataflow.transport import Bus, Envelope, Kind
from dataflow.transport.bounded import within
from dataflow.transport.codec import encode
from dataflow.transport.keys import local_key, runtime_key
from dataflow.transport.publisher import BusError
from dataflow.transport.registry import RunningGraph

AGAIN_AFTER = 0.05
"""Seconds until a process that is not there (yet, or again) is asked once more."""
CLOSE_WITHIN = 0.5


class NoAnswer(LookupError):
    """No process answered for an operator in time."""


class RequestRejected(ValueError):
    """The process of an operator refuses a parameter; the message has the reason."""


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """Status that one process gives of its operators.

    `counts`: per operator firings, messages emitted, messages dropped, CPU time (ns), last stamp, wall time (ns).
    `restarts`: how often each was restarted; `ended`: those that are through. `waits`: per operator how many, by
    (input, "timeout" or "late"). `behind`: per source the seconds by which its last message was behind the clock when
    it was read, and when it was sent. `firings`: batches of firing records, where they were asked for. `found`: what
    operators found wrong with what they were given. `silences`: the seconds since operators last fired, or began
    their first call. `after`:
    firings behind a cursor (`RecentFirings.after`).
    """

    process: str
    counts: Mapping[str, Sequence[int]]
    restarts: Mapping[str, int]
    ended: frozenset[str]
    waits: Mapping[str, Mapping[tuple[str, str], int]] = field(default_factory=dict)
    behind: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    firings: Sequence[bytes] = ()
    found: Mapping[str, str] = field(default_factory=dict)
    silences: Mapping[str, float] = field(default_factory=dict)
    after: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MachineStatus:
    """Another machine: whether its link is up, by how much its clock is ahead (`offset`, ns, at most half of `delay`
    wrong), and the messages that were dropped since its link took too little."""

    up: bool
    offset: int
    delay: int
    dropped: int


@dataclass(frozen=True, slots=True)
class Parameter:
    """The value that a parameter has now, and whether it can change while the graph runs."""

    value: Any
    tunable: bool


@dataclass(frozen=True, slots=True)
class PublishTarget:
    """A source that takes messages from outside: its port, and the names of the types it takes."""

    port: str
    types: tuple[str, ...]


class Processes:
    """The processes of one running graph. Every call waits for at most `timeout` seconds."""

    def __init__(self, bus: Bus, namespace: str) -> None:
        self._bus, self._namespace = bus, namespace

    def connected(self, number: int, timeout: float) -> bool:
        """Returns whether so many processes are reached by now."""
        deadline = time.monotonic() + timeout
        while len(self._bus.peers()) < number:
            if time.monotonic() > deadline:
                return False
            time.sleep(AGAIN_AFTER / 5)
        return True

    def statuses(
        self, timeout: float, *, firings: bool = False, after: Mapping[str, Any] | None = None
    ) -> list[ProcessStatus]:
        """Of the processes that answer, also while their operators are at work. `firings`: with the last ones; `after`:
        with those behind the cursors of earlier answers, by process."""
        asked = msgpack.packb({"firings": firings} | ({} if after is None else {"after": after}))
        answers = self._bus.ask(runtime_key(self._namespace, "status", "**"), asked, timeout=timeout)
        return sorted(map(_status, answers), key=lambda status: status.process)

    def machines(self, timeout: float) -> dict[str, MachineStatus]:
        """By name, the other machines of the graph."""
        answers = self._bus.ask(runtime_key(self._namespace, "machines"), timeout=timeout)
        return {n: MachineStatus(**s) for a in answers for n, s in msgpack.unpackb(a, raw=False).items()}

    def parameters(self, operators: Iterable[str], timeout: float) -> dict[str, dict[str, Parameter]]:
        """By operator, of those whose processes answer: between two firings."""
        wanted = list(operators)
        key = wanted[0] if len(wanted) == 1 else "**"
        answers: dict[str, dict[str, Parameter]] = {}
        for said in self._until(runtime_key(self._namespace, "param", key), {"get": True}, timeout):
            answers[said["operator"]] = {name: Parameter(**given) for name, given in said["value"].items()}
            if answers.keys() >= set(wanted):
                break
        return {name: answers[name] for name in wanted if name in answers}

    def set_parameter(self, operator: str, name: str, value: Any, timeout: float) -> Any:
        """Changes a parameter; the value as the operator took it. Raises `RequestRejected`, `NoAnswer`."""
        key = runtime_key(self._namespace, "param", operator)
        return self._answered(key, operator, {"name": name, "value": value}, timeout, "the change is made")

    def _answered(self, key: str, operator: str, request: Mapping[str, Any], timeout: float, then: str) -> Any:
        for said in self._until(key, request, timeout):
            if not said["ok"]:
                raise RequestRejected(said["error"])
            return said["value"]
        raise NoAnswer(
            f"no answer for {operator!r} within {timeout:g} s: it is being started again, hangs, or works on one "
            f"firing for longer than that; {then} when it comes to it"
        )

    def reload(self, operator: str, timeout: float) -> dict[str, Any]:
        """Has an operator go on with its code as it is in its files now; what its process answers (`Runner.reload`).
        Raises `RequestRejected`, `NoAnswer`."""
        key = local_key(self._namespace, "reload", operator)
        return dict(self._answered(key, operator, {"reload": True}, timeout, "it is reloaded"))

    def files(self, operator: str, timeout: float) -> dict[str, str]:
        """The digests of the modules that an operator's code is made of, as their files are now on its machine. Raises
        `RequestRejected`, `NoAnswer`."""
        key = local_key(self._namespace, "reload", operator)
        return dict(self._answered(key, operator, {"reload": True, "files": True}, timeout, "nothing is reloaded"))

    def takers(self, timeout: float) -> dict[str, PublishTarget]:
        """The sources that take messages from outside, by name."""
        answers = self._bus.ask(runtime_key(self._namespace, "pub", "**"), timeout=timeout)
        said = [msgpack.unpackb(answer, raw=False) for answer in answers]
        return {each["operator"]: PublishTarget(each["port"], tuple(each["types"])) for each in said}

    def publish(self, operator: str, message: Message, timeout: float) -> int:
        """Gives a message to a source that takes them from outside; returns its stamp, the event time of now where the
        message has the stamp 0. Raises `RequestRejected`, `NoAnswer`."""
        payload = encode(Envelope(Kind.MESSAGE, operator, 0, 0, message.stamp, message))
        for answer in self._bus.ask(runtime_key(self._namespace, "pub", operator), payload, timeout=timeout):
            said = msgpack.unpackb(answer, raw=False)
            if not said["ok"]:
                raise RequestRejected(said["error"])
            return int(said["stamp"])
        raise NoAnswer(f"{operator!r} did not answer within {timeout:g} s: whether it has the message is not known")

    def _until(self, key: str, request: Mapping[str, Any], timeout: float) -> Iterator[dict[str, Any]]:
        """Yields the answers to a request, which is repeated while no process takes it."""
        deadline = time.monotonic() + timeout
        payload = msgpack.packb(request)
        while (left := deadline - time.monotonic()) > 0:
            for answer in self._bus.ask(key, payload, timeout=left):
                yield msgpack.unpackb(answer, raw=False)
            time.sleep(AGAIN_AFTER)


def _status(answer: bytes) -> ProcessStatus:
    said = msgpack.unpackb(answer, raw=False)
    return ProcessStatus(
        said["process"],
        said["counts"],
        said["restarts"],
        frozenset(said["ended"]),
        {name: {(i, what): n for i, what, n in found} for name, found in said["waits"].items()},
        {name: (read, sent) for name, (read, sent) in said["behind"].items()},
        said.get("firings", ()),
        said["found"],
        said.get("silences", {}),
        said.get("after", {}),
    )


@contextlib.contextmanager
def processes_of(found: RunningGraph) -> Iterator[Processes]:
    """A connection to the processes of a running graph, which are reached one after the other from now on."""
    bus = Bus(network_of(found))
    try:
        yield Processes(bus, found.namespace)
    finally:
        with contextlib.suppress(BusError):  # a process that is stopped takes no leave; the caller need not wait for it
            within(CLOSE_WITHIN, bus.close, "bus close")
