"""The base class of runners: what a process asks of the operator or source that it runs, with defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from dataflow.execution.ports import Emitter, OutputPorts
from dataflow.execution.work import Work
from dataflow.graph.code import ReloadError
from dataflow.graph.model import Node
from dataflow.operator import Operator, OperatorSpec, ParameterError
from dataflow.sync import NEVER, Entry, Firing


class Faults(Protocol):
    """Faults of one operator on purpose."""

    def begin(self, kind: str, fields: Mapping[str, Any], now: float) -> None:
        """Plans a fault; `now`: on the steady clock, seconds."""

    def before(self, firing: Firing) -> BaseException | None:
        """Is asked before each firing: may take its time, and gives an error to fail with instead."""


class Runner:
    """One operator with inputs, driven step by step on one thread."""

    keeps_time = False
    """True when it may have something to do though nothing arrives (`next_due`)."""

    def __init__(self, node: Node, operator: Operator, emitter: Emitter, *, lossy: bool = False) -> None:
        self.node, self.operator, self.emitter = node, operator, emitter
        self.spec: OperatorSpec = operator.spec
        self.ports = OutputPorts(node, self.spec, emitter, lossy=lossy)
        self.firings = 0
        self.done = NEVER
        """Every firing at or before this stamp is made."""
        self.ended = False
        self.work = Work()
        """The time of the operator's calls, with checking and sending what came out of them."""
        self.working_since: float | None = None
        """When the call that is under way began (monotonic seconds), for the watchdog."""
        self.working_stamp = NEVER
        self.absent: set[str] = set()
        """Streams whose operator is gone at the moment; only a live run asks."""
        self.faults: Faults | None = None
        """Faults on purpose; only a live run asks."""
        self.awake = True
        """True when it is to be asked for a step."""
        self.place = 0
        self.wakes_in: list[Runner] = []
        """Its place in the graph and where it puts itself when it wakes (`dataflow.execution.driver`)."""

    def wake(self) -> None:
        """Asks to be stepped: something was given that may decide a firing, or there may be another one."""
        if not self.awake:
            self.awake = True
            self.wakes_in.append(self)

    def setup(self) -> None:
        """Sets the operator up and emits its static messages. Raises `OperatorFailure`."""
        raise NotImplementedError

    def push(self, stream: str, entry: Entry) -> None:
        """A message arrives. Raises `StreamOrderError`, which names the stream, where that had promised otherwise."""
        raise NotImplementedError

    def advance(self, stream: str, frontier: int) -> None:
        """A stream promises that no later message is at or before `frontier`. Raises `StreamOrderError`."""
        raise NotImplementedError

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """A stream ends. Raises `StreamOrderError`."""
        raise NotImplementedError

    def step(self) -> bool:
        """Makes the next firing if it is decided; False when there was nothing to do. Raises `OperatorFailure`. Where
        there may be more to do it wakes."""
        raise NotImplementedError

    def next_due(self) -> float | None:
        """Seconds until there is something to do though nothing arrives; None when nothing waits for the clock."""
        return None

    def waiting(self) -> tuple[int | None, dict[str, int]]:
        """The stamp that cannot be decided yet, and what would decide it, by input or stream."""
        return None, {}

    def set_parameter(self, name: str, value: Any) -> Any:
        """Changes a parameter between two firings; recorded. Returns the value as validated. Raises `ParameterError`
        for one that does not exist, cannot change while running, or is out of bounds."""
        raise ParameterError(f"the parameters of {self.node.name!r} cannot change here")

    def reload(self) -> dict[str, Any]:
        """Goes on with the operator's code as it is in its files now, between two firings; recorded as a restart.

        Returns as plain values the seconds it took (`seconds`), what has become of the state (`state`) and what is to
        be said (`warning`). Raises `ReloadError` where it cannot; the code is then as before.
        """
        raise ReloadError("only the operators of a live run are reloaded (run --live)")

    def close(self) -> None:
        """Closes the operator. Raises what that raises."""
        self.operator.close()

    def resume(self, incarnation: int, last: Mapping[str, int], changed: Mapping[str, Any]) -> None:
        """Takes the place of an operator whose process died; to be called before `setup()`."""
        raise NotImplementedError

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        """Messages that reached no firing so far, by (input, reason)."""
        return {}

    @property
    def timeouts(self) -> Mapping[str, int]:
        """Waits that were given up so far, by input."""
        return {}

    @property
    def late(self) -> Mapping[str, int]:
        """Messages that came after what needed them was decided, by input. Those for a trigger are dropped as well,
        as `late`; others serve later firings."""
        return {}

    @property
    def refused(self) -> Mapping[str, int]:
        """Returns what streams said against their own promises and was left aside, by stream; where it is not
        raised."""
        return {}

    @property
    def restarted(self) -> int:
        """Returns how often the operator was restarted in this process."""
        return 0
