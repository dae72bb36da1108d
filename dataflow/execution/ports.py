"""Output ports of one operator: which stamps they may carry, numbers, frontiers; and where all of it goes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.messages.digest import StreamDigest
from dataflow.operator import OperatorSpec, OutputError, OutputPort
from dataflow.records.firing import WITHHELD, Emission, FiringRecord
from dataflow.sync import FOREVER, NEVER, Entry


class Emitter(Protocol):
    """Takes a runner's output. Calls come in stream order."""

    def message(self, stream: str, entry: Entry) -> None:
        """A message was emitted; `entry.value` is the message."""

    def frontier(self, stream: str, frontier: int) -> None:
        """No later message of the stream has a stamp ≤ `frontier`."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """The stream has ended."""

    def record(self, record: FiringRecord) -> None:
        """A firing was made; called before its messages are sent, so no message is known that no record explains."""


@dataclass(slots=True)
class PortState:
    """One output port: its stream, the next sequence number, its last stamp and what it has promised."""

    port: OutputPort
    stream: str
    incarnation: int = 0
    seq: int = 0
    last: int = NEVER
    promised: int = NEVER
    digest: StreamDigest = field(default_factory=StreamDigest)


class OutputPorts:
    """The output ports of one operator: rule 5 of the time model, sequence numbers and frontiers."""

    def __init__(self, node: Node, spec: OperatorSpec, emitter: Emitter, *, lossy: bool = False) -> None:
        self.node, self.emitter, self.lossy = node, emitter, lossy
        streams = node.outputs  # a recorded graph lacks the ports that its operators have got since
        self.states = {name: PortState(port, streams[name]) for name, port in spec.outputs.items() if name in streams}
        self.withheld: Counter[str] = Counter()
        """Messages that were not sent because their stamps did not increase, by port."""
        self._prepared: list[Entry] = []
        self._nothing = (None,) * len(self.states)
        self._all = tuple(self.states.values())
        self._named = tuple(self.states.items())

    @property
    def emitted(self) -> int:
        """Returns how many messages were sent so far."""
        return sum(state.digest.count for state in self._all)

    def prepare(self, messages: Mapping[str, Message], firing: int) -> tuple[Emission | None, ...]:
        """Checks and numbers what one firing emitted; `publish` sends it, after the firing was recorded.

        Raises `OutputError` for a stamp that the port may not carry. With `lossy`, a stamp that does not increase is
        no error: the message is not sent, and its emission is marked `withheld`.
        """
        if not messages:
            return self._nothing
        for name, message in messages.items():
            stamp = message.stamp
            if stamp < firing or stamp <= self.states[name].last:
                self.check(messages, firing)
                break
        emissions: list[Emission | None] = []
        for name, state in self._named:
            emitted = messages.get(name)
            if emitted is None:
                emissions.append(None)
                continue
            digest, stamp = emitted.digest(), emitted.stamp
            if stamp <= state.last:
                self.withheld[name] += 1
                emissions.append(Emission(WITHHELD, stamp, digest))
                continue
            seq = state.seq
            state.digest.update(digest)
            self._prepared.append(Entry(stamp, emitted, seq, state.incarnation, digest, state.stream))
            state.last = state.promised = stamp
            emissions.append(Emission(seq, stamp, digest))
            state.seq = seq + 1
        return tuple(emissions)

    def check(self, messages: Mapping[str, Message], firing: int) -> None:
        """Raises `OutputError` for a stamp that the port may not carry."""
        for name, message in messages.items():
            state = self.states[name]
            stamp = message.stamp
            if firing <= stamp and state.last < stamp:
                continue
            if stamp < firing - state.port.lag:
                allowed = f"at or after the firing's {firing}" + (
                    f" less its lag of {state.port.lag} ns" if state.port.lag else ""
                )
                raise OutputError(f"{self.node.name}.{name} emitted stamp {stamp}; it must lie {allowed}")
            if stamp <= state.last and not self.lossy:
                raise OutputError(
                    f"{self.node.name}.{name} emitted stamp {stamp} after {state.last}: "
                    "the stamps of a stream strictly increase"
                )

    def emit_as(self, name: str, message: Message, seq: int, incarnation: int) -> None:
        """Sends a message under the number that it had in a recorded run."""
        state = self.states[name]
        digest = message.digest()
        state.digest.update(digest)
        state.last = state.promised = max(state.promised, message.stamp)
        self.emitter.message(state.stream, Entry(message.stamp, message, seq, incarnation, digest, state.stream))

    def end_statics(self) -> None:
        """Ends the streams that carry one message."""
        for state in self.states.values():
            if state.port.static:
                self.emitter.end(state.stream, None, "static")
                state.promised = FOREVER

    def publish(self) -> None:
        """Sends what was prepared, in order."""
        prepared = self._prepared
        if prepared:
            self._prepared = []
            for entry in prepared:
                self.emitter.message(entry.stream, entry)

    def begin(self, incarnation: int, *, stamps_go_back: bool = False) -> None:
        """Begins a new incarnation of every dynamic port: numbers from 0 again, and stamps too if they may go back."""
        for state in self.states.values():
            if state.port.static:
                continue
            state.incarnation, state.seq = incarnation, 0
            if stamps_go_back:
                state.last = state.promised = NEVER

    def resume(self, incarnation: int, last: Mapping[str, int]) -> None:
        """Goes on where an earlier process of this operator ended: its last stamps, by port."""
        self.begin(incarnation)
        for name, stamp in last.items():
            self.states[name].last = self.states[name].promised = stamp

    def promise(self, frontier: int) -> None:
        """Raises the frontier of every dynamic port to `frontier` less its lag, where that is news."""
        for state in self._all:
            if frontier <= state.promised:
                continue
            if state.port.static or frontier in (NEVER, FOREVER):
                continue
            trailing = frontier - state.port.lag
            if trailing > state.promised:
                state.promised = trailing
                self.emitter.frontier(state.stream, trailing)

    def end(self, final: int | None, reason: str) -> None:
        """Ends every dynamic port at `final`, or at what it emitted or promised later."""
        for state in self.states.values():
            if state.promised != FOREVER:
                reached = max(NEVER if final is None else final, state.promised)
                state.promised = FOREVER
                self.emitter.end(state.stream, None if reached == NEVER else reached, reason)
