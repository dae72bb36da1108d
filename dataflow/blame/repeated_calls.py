"""Calls made again with other inputs, and what comes of it in later calls."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from dataflow.blame.line import Call, Line
from dataflow.messages.base import Message
from dataflow.sync import Entry, Firing, InputValue
from dataflow.sync.entries import entries_of

Place = tuple[str, int, int]
"""Stream, incarnation and number of a message."""
Slot = tuple[str, int]
"""A message of an input: the input's name, and its place among those that it was given."""
Other = Mapping[str, InputValue] | None
"""Inputs that a call is given instead; None: it is not made."""
AS_IT_WAS: Any = object()
RAISED: Any = object()
"""A call that did not raise in the run raised."""


class Effects:
    """Calls made again with other inputs, in the order of the run, as far as what comes out is other."""

    def __init__(
        self,
        lines: Mapping[str, Line],
        takers: Mapping[Place, Sequence[Call]],
        last: Mapping[str, int],
        age: Callable[[Call], tuple[int, int, int]],
    ) -> None:
        self._lines, self._takers, self._last, self._age = lines, takers, last, age
        self._others: dict[Place, Message | None] = {}
        self._left: list[tuple[tuple[int, ...], Call]] = []
        self._queued: set[Call] = set()
        self.raised = ""
        self._under_way: set[str] = set()
        """Operators that were begun: those with a state make all calls from there on."""

    def through(
        self,
        others: Mapping[Call, Other],
        anew: Call | None,
        target: Call,
        port: str,
        messages: Mapping[Place, Message] | None = None,
    ) -> Any:
        """Returns the target's message; `AS_IT_WAS` where nothing reached it, `RAISED` where a call raises, which shows
        nothing (`raised`: in words). `messages`: those of sensors that are others for all calls that take them."""
        for place, message in (messages or {}).items():
            self._others[place] = message
            for taker in self._takers.get(place, ()):
                self._queue(taker)
        for call in (*others, *([anew] if anew is not None else ())):
            self._queue(call)
        while self._left:
            _, call = heapq.heappop(self._left)
            line, shot = self._lines[call.operator], self._lines[call.operator].shots[call.number]
            if call.operator not in self._under_way or line.stateless:
                line.begin(call.number, anew=call == anew)
                self._under_way.add(call.operator)
            inputs = others[call] if call in others else self._inputs(line, call.number)
            if inputs is None:
                line.skip(call.number)
                made: Mapping[str, Message] | None = {}
            else:
                made = line.fire(call.number, replace(shot.firing, inputs=inputs), other=True)
            if made is None and line.records[call.number].outcome == "error":
                made = {}  # as in the run
            if made is None:
                line.leave()
                self.raised = f"{call.operator} #{call.number} raises {line.error}"
                return RAISED
            if call == target:
                return made.get(port)
            self._hand_on(call, line, made)
            if not line.stateless:
                after = next(
                    (n for n in range(call.number + 1, self._last[call.operator] + 1) if n in line.shots), None
                )
                if after is not None and line.begin_of(after) <= call.number:
                    self._queue(Call(call.operator, after))
        return AS_IT_WAS

    def _queue(self, call: Call) -> None:
        if call not in self._queued and call.number <= self._last.get(call.operator, -1):
            self._queued.add(call)
            heapq.heappush(self._left, (tuple(-part for part in self._age(call)), call))

    def _hand_on(self, call: Call, line: Line, made: Mapping[str, Message]) -> None:
        """Notes the messages that are others than they were, and queues the calls that take them."""
        record, here = line.records[call.number], line.shots[call.number].here
        for (port, stream), emission in zip(line.node.outputs.items(), record.outputs, strict=False):
            now = made.get(port)
            if emission is None or (None if now is None else now.digest()) == here.get(port):
                continue
            place = stream, record.incarnation, emission.seq
            self._others[place] = now
            for taker in self._takers.get(place, ()):
                self._queue(taker)

    def _inputs(self, line: Line, number: int) -> Mapping[str, InputValue] | None:
        """The inputs of a call with the messages that are others; None where one without which it is not made is
        missing."""
        firing = line.shots[number].firing
        inputs = dict(firing.inputs)
        for name, given in firing.inputs.items():
            if not any(place_of(entry) in self._others for entry in entries_of(given)):
                continue
            kept = [(entry, self._others.get(place_of(entry), entry.value)) for entry in entries_of(given)]
            inputs[name] = _like(given, [_entry(entry, message) for entry, message in kept if message is not None])
            if inputs[name] is None:
                inputs[name] = self._sample_before(line, number, name, given)
            if not inputs[name] and not isinstance(given, tuple) and _is_needed(line, name):
                return None
        return inputs

    @staticmethod
    def _sample_before(line: Line, number: int, name: str, given: InputValue) -> Entry | None:
        """Returns what a Sampled input gives where its message has not come: the last other one that a call took."""
        if line.node.operator.spec.inputs[name].kind == "sampled":
            for earlier in range(number - 1, -1, -1):
                other = line.shots[earlier].firing.inputs.get(name) if earlier in line.shots else given
                if isinstance(other, Entry) and other != given:
                    return other
        return None


def _is_needed(line: Line, name: str) -> bool:
    """Returns whether no call is made without a message in an input."""
    spec = line.node.operator.spec
    port = spec.inputs[name]
    return port.required if port.kind == "sampled" else not spec.merge


def with_messages(firing: Firing, messages: Mapping[Slot, Message]) -> Mapping[str, InputValue]:
    """The inputs of a firing with other messages in some places."""
    inputs = dict(firing.inputs)
    for name in {name for name, _ in messages}:
        given = inputs[name]
        entries = [_entry(e, messages.get((name, k), e.value)) for k, e in enumerate(entries_of(given))]
        inputs[name] = _like(given, entries)
    return inputs


def _like(given: InputValue, entries: Sequence[Entry]) -> InputValue:
    """Returns entries in the form in which an input was given others; None for none in place of a single one."""
    if isinstance(given, tuple):
        return tuple(entries)
    if isinstance(given, Mapping):
        return {entry.stream: entry for entry in entries}
    return entries[0] if entries else None


def _entry(entry: Entry, message: Message) -> Entry:
    return Entry(entry.stamp, message, entry.seq, entry.incarnation, message.digest(), entry.stream)


def place_of(entry: Entry) -> Place:
    return entry.stream, entry.incarnation, entry.seq
